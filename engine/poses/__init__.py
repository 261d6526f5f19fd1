"""Poses for photographs that have none: features, matches, mapping by COLMAP, and checks of what came out.

And for those of a given model that stand in the wrong place, or whose lens moved.
"""

from octasplat.engine.poses.config import Given, PosesConfig
from octasplat.engine.poses.find import adjust_lenses, find_poses, place_doubtful
from octasplat.engine.poses.lens_doubt import lens_is_in_doubt

__all__ = ["Given", "PosesConfig", "adjust_lenses", "find_poses", "lens_is_in_doubt", "place_doubtful"]
