"""Mean-value coordinates and winding numbers said slowly, one point and one triangle at a time."""

import math

import numpy as np


def reference_coordinates(
    point: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, size: float
) -> np.ndarray:
    """Of a point in a closed mesh (Ju, Schaefer, Warren 2005)."""
    way = vertices - point
    lengths = np.linalg.norm(way, axis=1)
    if lengths.min() < 1e-9 * size:
        return np.eye(len(vertices))[lengths.argmin()]
    unit = way / lengths[:, None]
    weights = np.zeros(len(vertices))
    for triangle in triangles:
        u = unit[triangle]
        normals = np.cross(u[[1, 2, 0]], u[[2, 0, 1]])
        sines = np.linalg.norm(normals, axis=1)
        angles = np.arctan2(sines, (u[[1, 2, 0]] * u[[2, 0, 1]]).sum(axis=1))
        volume = u[0] @ normals[0]
        if abs(volume) <= 1e-9 * sines[0]:
            if angles.sum() < 2 * math.pi - 1e-6:
                continue  # beside the triangle in its plane
            areas = np.sin(angles) * lengths[triangle[[1, 2, 0]]] * lengths[triangle[[2, 0, 1]]]
            on_it = np.zeros(len(vertices))
            on_it[triangle] = areas / areas.sum()
            return on_it
        mean = (0.5 * angles / np.maximum(sines, 1e-300)) @ normals
        weights[triangle] += normals @ mean / (volume * lengths[triangle])
    return weights / weights.sum()


def reference_winding_numbers(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """How often a closed mesh winds round each point, by its solid angles."""
    a, b, c = np.moveaxis(vertices[triangles] - points[:, None, None], 2, 0)
    a, b, c = (way / np.linalg.norm(way, axis=-1, keepdims=True) for way in (a, b, c))
    volume = (a * np.cross(b, c)).sum(axis=-1)
    dots = 1 + (a * b).sum(axis=-1) + (b * c).sum(axis=-1) + (c * a).sum(axis=-1)
    return np.rint(np.arctan2(volume, dots).sum(axis=1) / (2 * math.pi)).astype(int)
