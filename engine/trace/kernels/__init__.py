"""Numba's tools for kernels, and the kernels of triangle meshes."""
