"""What was photographed: COLMAP models, cameras as rays, pixels in a mapped cache, masks and the split.

This package knows nothing of Gaussians. :class:`Dataset` is what training and evaluation read.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.model import (
    DatasetModel,
    DatasetView,
    PosedView,
    SparsePoints,
    Viewpoints,
    scene_extent,
)
from octasplat.engine.dataset.split import split_views, write_held_out

if TYPE_CHECKING:
    from octasplat.engine.dataset.dataset import Dataset
    from octasplat.engine.dataset.load import load_dataset_model

# Compilers and image libraries come with these; whoever only checks a COLMAP model has neither.
_LAZY_EXPORTS = {
    "Dataset": "octasplat.engine.dataset.dataset",
    "load_dataset_model": "octasplat.engine.dataset.load",
}

__all__ = [
    "Camera",
    "Dataset",
    "DatasetModel",
    "DatasetView",
    "PosedView",
    "SparsePoints",
    "Viewpoints",
    "load_dataset_model",
    "scene_extent",
    "split_views",
    "write_held_out",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY_EXPORTS:
        return getattr(import_module(_LAZY_EXPORTS[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
