"""Numba kernels of editing."""
