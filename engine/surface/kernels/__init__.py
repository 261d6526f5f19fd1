"""Numba kernels of surface extraction."""
