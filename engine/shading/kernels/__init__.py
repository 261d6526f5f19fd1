"""Compiled kernels of shading."""
