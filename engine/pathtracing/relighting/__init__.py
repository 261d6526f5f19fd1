"""Relighting of scenes with materials: by path tracing or by the split sum."""
