"""Numba kernels that gather pixels and rays."""
