"""Photographs and their cameras: COLMAP models, rays, pixels in a mapped cache, masks and the test split.

This package knows nothing of Gaussians. :class:`Dataset` is what training and evaluation read.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from octasplat.engine.dataset.camera import Camera
    from octasplat.engine.dataset.dataset import Dataset
    from octasplat.engine.dataset.load import load_dataset_model
    from octasplat.engine.dataset.model import (
        DatasetModel,
        DatasetView,
        PosedView,
        SparsePoints,
        Viewpoints,
        scene_extent,
    )
    from octasplat.engine.dataset.split import split_views, write_held_out

# Compilers, COLMAP and image libraries come with these; whoever only asks for sizes of images needs none.
_LAZY_EXPORTS = {
    "Camera": "camera",
    "Dataset": "dataset",
    "DatasetModel": "model",
    "DatasetView": "model",
    "PosedView": "model",
    "SparsePoints": "model",
    "Viewpoints": "model",
    "load_dataset_model": "load",
    "scene_extent": "model",
    "split_views": "split",
    "write_held_out": "split",
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
        return getattr(import_module(f"{__name__}.{_LAZY_EXPORTS[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
