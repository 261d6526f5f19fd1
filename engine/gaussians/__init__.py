"""Flat Gaussians: parameters, frames, octagons, channels and transforms."""
