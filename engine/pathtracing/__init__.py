"""Light in a scene: stages of meshes, lights and Gaussians, their materials, and the path tracer for them."""
