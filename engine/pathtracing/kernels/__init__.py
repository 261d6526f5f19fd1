"""Numba kernels of the path tracer, and the tuples of arrays that they take."""
