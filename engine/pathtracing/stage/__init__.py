"""The stage file: the meshes, lights and camera that are put into a scene."""
