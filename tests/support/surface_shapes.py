"""Shapes whose surfaces are known, as volumes and depth maps."""

from collections.abc import Callable

import numpy as np

from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.pose_paths import look_at
from octasplat.engine.surface.kernels.tsdf import VOXELS_PER_BLOCK
from octasplat.engine.surface.region import BLOCK, Region
from octasplat.engine.surface.tsdf_volume import TsdfVolume


def volume_of(distance: Callable[[np.ndarray], np.ndarray], blocks: int, voxel: float = 1.0) -> TsdfVolume:
    """A dense volume of a signed distance function of world positions, centred at the origin."""
    low = np.full(3, -0.5 * blocks * BLOCK * voxel)
    region = Region(low, voxel, (blocks, blocks, blocks), False, np.zeros(3), 1.0, 4.0)
    rows = np.argwhere(np.ones((blocks,) * 3)).astype(np.int32)
    table = np.arange(blocks**3, dtype=np.int32).reshape((blocks,) * 3)
    values = distance(voxel_centres(region, rows).reshape(-1, 3)).reshape(-1, VOXELS_PER_BLOCK)
    values = np.clip(values / (4 * voxel), -1, 1).astype(np.float32)
    return TsdfVolume(region, table, rows, values, np.ones_like(values))


def voxel_centres(region: Region, blocks: np.ndarray) -> np.ndarray:
    """World positions (b, 512, 3) of the voxels of blocks."""
    inside = np.argwhere(np.ones((BLOCK,) * 3))
    places = (blocks[:, None] * BLOCK + inside).reshape(-1, 3).astype(np.float64)
    return region.world_from_grid(places).reshape(len(blocks), VOXELS_PER_BLOCK, 3)


def sphere(points: np.ndarray, radius: float = 9.0) -> np.ndarray:
    return np.linalg.norm(points, axis=1) - radius


def cameras_on_sphere(count: int, distance: float, side_px: int, fov: float = 50.0) -> list[PinholeCamera]:
    order = np.arange(count)
    height, angle = 1 - (2 * order + 1) / count, order * 2.399963
    across = np.sqrt(1 - height**2)
    places = distance * np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
    return [
        PinholeCamera.from_pose(
            look_at(place, np.zeros(3), np.array([0.36, 0.48, 0.8])),
            side_px,
            side_px,
            fy_px=focal_from_fov(fov, side_px),
        )
        for place in places
    ]


def sphere_depth(camera: PinholeCamera, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Distances along the rays of a camera to a sphere at the origin (infinite beside it), and cosines."""
    rays = camera.rays()
    origin, directions = rays.origin_world, rays.directions_world
    origin = origin.astype(np.float64)
    along = directions.astype(np.float64) @ origin
    root = along**2 - origin @ origin + radius**2
    distance = np.where(root > 0, -along - np.sqrt(np.maximum(root, 0)), np.inf)
    finite = np.where(root > 0, distance, 0.0)
    normal = (origin + finite[..., None] * directions) / radius
    cosine = np.where(root > 0, -(normal * directions).sum(-1), 0.0)
    return distance.astype(np.float32), cosine.astype(np.float32)
