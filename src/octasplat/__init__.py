"""Photographs to scenes of flat Gaussians, by ray tracing on an ordinary CPU."""

from octasplat.engine import __version__

__all__ = ["__version__"]
