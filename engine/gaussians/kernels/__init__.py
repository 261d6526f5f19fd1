"""Functions that numba compiles for kernels of other folders."""
