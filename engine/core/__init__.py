"""Shared foundations of the engine: errors, events, rays, colors, threads, compilation and file writing."""
