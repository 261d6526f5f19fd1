"""Georeferences: where a scene lies and how large it is, by GPS, control points, or a known length."""
