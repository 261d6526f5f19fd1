"""Poses for photographs that have none: features, matches, mapping by COLMAP, and checks of what came out."""

from engine.poses.config import PosesConfig
from engine.poses.find import find_poses

__all__ = ["PosesConfig", "find_poses"]
