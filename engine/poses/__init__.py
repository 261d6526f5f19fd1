"""Poses for photographs that have none: features, matches, mapping by COLMAP, and checks of what came out."""

from engine.poses.find import PosesConfig, find_poses

__all__ = ["PosesConfig", "find_poses"]
