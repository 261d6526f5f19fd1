"""Poses for photographs that have none: features, matches, mapping by COLMAP, and checks of what came out.

And for those of a given model that stand in the wrong place, or whose lens moved.
"""

from octasplat.engine.poses.config import GivenModel, PosesConfig
from octasplat.engine.poses.find_poses import adjust_principal_points, find_poses, repair_poses
from octasplat.engine.poses.lens_check import needs_per_view_principal_points

__all__ = [
    "GivenModel",
    "PosesConfig",
    "adjust_principal_points",
    "find_poses",
    "needs_per_view_principal_points",
    "repair_poses",
]
