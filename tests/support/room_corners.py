"""Photographs of corners of rooms with blotched walls: each seed is a place that no other one resembles."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.ndimage import map_coordinates, zoom
from scipy.spatial.transform import Rotation

from octasplat.engine.render.image_files import write_png

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 320, 240, 280.0
SIDE_WORLD, TEXELS = 6.0, 768


def write_corner(folder: Path, prefix: str, count: int, *, seed: int) -> list[str]:
    """Write photographs of one corner, taken along an arc before it; returns their names."""
    rng = np.random.default_rng(seed)
    walls = [_blotches(rng) for _ in range(3)]
    x, y = np.meshgrid(np.arange(WIDTH_PX) + 0.5, np.arange(HEIGHT_PX) + 0.5)
    rays_cam = np.stack([x - WIDTH_PX / 2, y - HEIGHT_PX / 2, np.full_like(x, FOCAL_PX)], axis=-1)
    names = []
    for k, angle in enumerate(np.linspace(20, 70, count)):
        centre = 3.2 * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
        centre[2] = 1.4 + 0.25 * (k % 3)
        ahead = np.array([0.5, 0.5, 0.9]) - centre
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        world_from_cam = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        turn = Rotation.from_euler("z", 4 * (k % 2), degrees=True).as_matrix()
        rays = rays_cam @ (world_from_cam @ turn).T
        names.append(f"{prefix}{k:02d}.png")
        shown = _shade(centre, rays, walls)
        write_png(folder / names[-1], np.repeat(shown[..., None], 3, axis=2).astype(np.float32))
    return names


def _blotches(rng: np.random.Generator) -> Float64[np.ndarray, "t t"]:
    """Return a texture of blotches of several sizes, between 0 and 1."""
    sizes = (12, 24, 48, 96, 192)
    found = sum(zoom(rng.random((size, size)), TEXELS / size, order=1) * size**-0.3 for size in sizes)
    low, high = np.percentile(found, (1, 99))
    return np.clip((found - low) / (high - low), 0, 1)


def _shade(
    centre: Float64[np.ndarray, "3"],
    rays: Float64[np.ndarray, "h w 3"],
    walls: list[Float64[np.ndarray, "t t"]],
) -> Float64[np.ndarray, "h w"]:
    """Return what rays see of the three planes through the origin."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.where(rays < 0, -centre / rays, np.inf)
    nearest = np.argmin(distances, axis=-1)
    points = centre + rays * np.min(distances, axis=-1)[..., None]
    shown = np.zeros(nearest.shape)
    for axis, wall in enumerate(walls):
        on_wall = nearest == axis
        texels = np.delete(points[on_wall], axis, axis=1).T * (TEXELS / SIDE_WORLD)
        shown[on_wall] = map_coordinates(wall, texels, order=1, mode="mirror")
    return shown
