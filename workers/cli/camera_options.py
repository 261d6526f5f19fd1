"""Axes of the world, as options name them."""

AXES = ("x", "-x", "y", "-y", "z", "-z")
