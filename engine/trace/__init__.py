"""Ray tracing of flat Gaussians (protocol, CPU tracer, reference implementation) and of triangle meshes."""
