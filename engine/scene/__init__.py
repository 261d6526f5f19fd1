"""What was photographed: COLMAP models, cameras as rays, pixels in a mapped cache, masks and the split.

This package knows nothing of Gaussians. :class:`Dataset` is what training and evaluation read.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from octasplat.engine.scene.cameras import Camera
from octasplat.engine.scene.model import PosedView, SceneModel, SparsePoints, View, Viewpoints, scene_extent
from octasplat.engine.scene.split import split_views, write_held_out

if TYPE_CHECKING:
    from octasplat.engine.scene.dataset import Dataset
    from octasplat.engine.scene.load import load_scene

# Compilers and image libraries come with these; whoever only checks a COLMAP model has neither.
_HEAVY = {"Dataset": "octasplat.engine.scene.dataset", "load_scene": "octasplat.engine.scene.load"}

__all__ = [
    "Camera",
    "Dataset",
    "PosedView",
    "SceneModel",
    "SparsePoints",
    "View",
    "Viewpoints",
    "load_scene",
    "scene_extent",
    "split_views",
    "write_held_out",
]


def __getattr__(name: str) -> Any:
    if name in _HEAVY:
        return getattr(import_module(_HEAVY[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
