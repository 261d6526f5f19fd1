"""Poses for photographs that have none: features, matches, mapping by COLMAP, and checks of what came out.

And for those of a given model that stand in the wrong place.
"""

from engine.poses.config import Given, PosesConfig
from engine.poses.find import find_poses, place_doubtful

__all__ = ["Given", "PosesConfig", "find_poses", "place_doubtful"]
