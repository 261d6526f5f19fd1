"""Kernels of the image metrics."""
