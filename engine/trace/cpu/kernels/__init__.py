"""Numba kernels of the CPU tracer, and the tuples of arrays that they take."""
