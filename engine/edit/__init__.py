"""Scenes changed after training: meshes edited elsewhere, proxies that drive a scene, selection, clean-up."""
