"""Rays through flat Gaussians: the protocol, the Embree tracer, its slow twin and the autograd bridge."""
