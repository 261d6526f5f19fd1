"""What all parts of the engine use: errors, events, rays, colors, threads, compilation, and writing files."""
