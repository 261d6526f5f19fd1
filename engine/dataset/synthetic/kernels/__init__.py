"""Numba kernels of the generated scene."""
