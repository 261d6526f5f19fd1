"""Edits of trained scenes: meshes edited elsewhere, proxies that deform a scene, selection and clean-up."""
