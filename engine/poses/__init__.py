"""Poses for photographs that have none: features, matches, mapping by COLMAP, and checks of what came out.

And for those of a given model that stand in the wrong place, or whose lens moved.
"""
