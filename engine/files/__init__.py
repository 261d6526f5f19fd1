"""Files of scenes, meshes and surfaces: splats in and out, octagon meshes in and out, surfaces out."""
