"""Flat Gaussians, their frames and octagons, and the PLY file that holds them."""
