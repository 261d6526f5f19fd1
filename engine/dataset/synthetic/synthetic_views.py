"""Cameras of the synthetic photographs: poses and intrinsics."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.dataset.synthetic.config import SyntheticDatasetConfig
from octasplat.engine.dataset.synthetic.street import half_length

# (share of the views, distance from the table's axis, height above the table), metres.
_RINGS = ((0.4, 2.45, 0.5), (0.35, 2.25, 1.05), (0.25, 1.75, 1.75))
_TARGET_WORLD = np.array([0.0, 0.0, 0.16])
_HALF_FOV = np.radians(27)
# Of the walks along the street: directions of a station in degrees from +x to the other side, and pitches.
_YAWS, _PITCHES = (20.0, 65.0, 115.0, 160.0), (3.0, 14.0)
_WALK_END = 4.0
"""From the last station to the end of the street, metres."""


@dataclass(frozen=True)
class SyntheticView:
    """A photograph's name and pose: x_cam = rotation x_world + translation (x right, y down, z ahead)."""

    name: str
    rotation_cam_from_world: Float[np.ndarray, "3 3"]
    translation_cam_from_world: Float[np.ndarray, "3"]

    @property
    def centre_world(self) -> Float[np.ndarray, "3"]:
        """Return the camera centre in world coordinates."""
        return -self.rotation_cam_from_world.T @ self.translation_cam_from_world


def synthetic_camera(config: SyntheticDatasetConfig) -> pycolmap.Camera:
    """Return the camera of all photographs; its principal point is slightly off-centre, as in real ones."""
    width, height = config.width_px, config.height_px
    focal = 0.5 * width / np.tan(_HALF_FOV)
    cx, cy = 0.5 * width + 0.011 * width, 0.5 * height - 0.008 * width
    params: dict[str, list[float]] = {
        "SIMPLE_PINHOLE": [focal, cx, cy],
        "PINHOLE": [focal, focal, cx, cy],
        "SIMPLE_RADIAL": [focal, cx, cy, -0.11],
        "OPENCV": [focal, 1.01 * focal, cx, cy, -0.16, 0.045, 0.0015, -0.001],
        "OPENCV_FISHEYE": [focal, 1.01 * focal, cx, cy, 0.03, -0.012, 0.004, -0.001],
    }
    return pycolmap.Camera(
        camera_id=1, model=config.camera_model, width=width, height=height, params=params[config.camera_model]
    )


def synthetic_views(config: SyntheticDatasetConfig) -> list[SyntheticView]:
    """Return all views of the scene that ``config`` names."""
    return _street_views(config) if config.scene == "street" else _table_views(config)


def _table_views(config: SyntheticDatasetConfig) -> list[SyntheticView]:
    """Return the views ring by ring from the lowest; each looks at about the middle of the still life."""
    random = np.random.default_rng([config.seed, 1])
    ends = np.round(np.cumsum([share for share, _, _ in _RINGS]) * config.views).astype(int)
    counts = np.diff(ends, prepend=0)
    made: list[SyntheticView] = []
    for ring, (count, (_, distance, height)) in enumerate(zip(counts, _RINGS, strict=True)):
        for k in range(count):
            angle = 2 * np.pi * (k + 0.37 * ring + random.uniform(-0.12, 0.12)) / count
            reach = distance * random.uniform(0.94, 1.05)
            centre = np.array(
                [reach * np.cos(angle), reach * np.sin(angle), height + random.uniform(-0.12, 0.12)]
            )
            ahead = _TARGET_WORLD + random.uniform(-0.06, 0.06, 3) - centre
            made.append(_view_towards(len(made), config.views, centre, ahead, random.uniform(-0.03, 0.03)))
    return made


def _street_views(config: SyntheticDatasetConfig) -> list[SyntheticView]:
    """Return the views of two walks along the street, each looking at the other side, straight and aslant.

    Stations follow each other along x, and so do the names.
    """
    random = np.random.default_rng([config.seed, 1])
    each = len(_YAWS)
    stations = -(-config.views // (2 * each))
    walk = half_length(config.houses) - _WALK_END
    made: list[SyntheticView] = []
    for station in range(stations):
        for lane in (-1.0, 1.0):
            x = walk * ((2 * station + 1 + 0.5 * lane) / stations - 1)
            y = lane * random.uniform(2.1, 2.7)
            centre = np.array([x + random.uniform(-0.2, 0.2), y, random.uniform(1.5, 1.8)])
            for place, yaw in enumerate(_YAWS):
                angle = np.radians(yaw + random.uniform(-4, 4))
                rise = np.tan(np.radians(_PITCHES[(place + station) % 2] + random.uniform(-2, 2)))
                ahead = np.array([np.cos(angle), -lane * np.sin(angle), rise])
                if len(made) < config.views:
                    roll = random.uniform(-0.02, 0.02)
                    made.append(_view_towards(len(made), config.views, centre, ahead, roll))
    return made


def _view_towards(
    number: int, count: int, centre: Float[np.ndarray, "3"], ahead: Float[np.ndarray, "3"], roll: float
) -> SyntheticView:
    """Return the view ``number`` of ``count`` from ``centre`` along ``ahead``, turned by ``roll`` radians."""
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right
    rotation = np.stack([right, down, ahead])
    digits = max(3, len(str(count - 1)))
    return SyntheticView(f"view_{number:0{digits}d}.png", rotation, -rotation @ centre)


def directions_cam(camera: pycolmap.Camera, pixels: Float[np.ndarray, "n 2"]) -> Float32[np.ndarray, "n 3"]:
    """Return camera-frame directions (x, y, 1) through image positions, lens distortion undone."""
    xy = camera.cam_from_img(np.ascontiguousarray(pixels, np.float64))
    return np.concatenate([xy, np.ones((len(xy), 1))], axis=1).astype(np.float32)


def project_visible(
    camera: pycolmap.Camera, view: SyntheticView, points_world: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 2"]:
    """Project points to image positions, not-a-number behind the camera or outside the photograph."""
    in_cam = points_world @ view.rotation_cam_from_world.T + view.translation_cam_from_world
    pixels = np.full((len(in_cam), 2), np.nan)
    ahead = np.flatnonzero(in_cam[:, 2] > 1e-6)
    if len(ahead):
        pixels[ahead] = camera.img_from_cam(np.ascontiguousarray(in_cam[ahead]))
    with np.errstate(invalid="ignore"):
        outside = ~((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1)
    pixels[outside] = np.nan
    return pixels
