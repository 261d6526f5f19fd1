"""Rays through flat Gaussians: the protocol, the tracer for CPUs, its slow twin; and rays through meshes."""
