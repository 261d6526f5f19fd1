"""Path tracing of stages: meshes, lights and Gaussians with materials."""
