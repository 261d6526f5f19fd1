"""What was photographed: COLMAP models, cameras as rays, pixels in a mapped cache, masks and the split.

This package knows nothing of Gaussians. :class:`Dataset` is what training and evaluation read.
"""

from engine.scene.cameras import Camera
from engine.scene.dataset import Dataset
from engine.scene.load import load_scene
from engine.scene.model import SceneModel, SparsePoints, View, scene_extent
from engine.scene.split import split_views, write_held_out

__all__ = [
    "Camera",
    "Dataset",
    "SceneModel",
    "SparsePoints",
    "View",
    "load_scene",
    "scene_extent",
    "split_views",
    "write_held_out",
]
