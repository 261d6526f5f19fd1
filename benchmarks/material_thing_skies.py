"""The environments of ``benchmarks.material_things``: equirectangular maps, made by formulas.

Rows run from the top (+z) to the bottom, columns clockwise seen from above; the middle column looks along +x.
Values are linear radiance of a mean luminance of ``MEAN_LUMINANCE`` with lamps and suns left out.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Float32

from octasplat.engine.dataset.synthetic.patterns import gradient_noise

MEAN_LUMINANCE = 0.45
HEIGHT = 256
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
Directions = Float[np.ndarray, "h w 3"]


def map_directions(height: int) -> Directions:
    """Return the unit world direction of each texel's centre."""
    v, u = np.meshgrid(
        (np.arange(height) + 0.5) / height, (np.arange(2 * height) + 0.5) / (2 * height), indexing="ij"
    )
    across, azimuth = np.sin(np.pi * v), 2 * np.pi * (0.5 - u)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(np.pi * v)], axis=-1)


def _disc(
    directions: Directions, azimuth: float, elevation: float, radius: float
) -> Float[np.ndarray, "h w 1"]:
    """Return 1 within an angle of a direction, 0 outside, with a border of a tenth of it; degrees."""
    a, e = np.radians(azimuth), np.radians(elevation)
    centre = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    angle = np.degrees(np.arccos(np.clip(directions @ centre, -1, 1)))
    return np.clip((1.05 * radius - angle) / (0.1 * radius), 0, 1)[..., None]


def _noise(directions: Directions, scale: float, seed: int, octaves: int = 5) -> Float[np.ndarray, "h w 1"]:
    flat = np.ascontiguousarray(directions.reshape(-1, 3) * scale, np.float32)
    return (
        gradient_noise(flat, octaves=octaves, seed=seed).reshape(*directions.shape[:2], 1).astype(np.float64)
    )


def _window(
    directions: Directions, azimuth: float, elevation: float, width: float, height: float
) -> Float[np.ndarray, "h w 1"]:
    """Return 1 in a rectangle of azimuths and elevations, degrees."""
    around = np.degrees(np.arctan2(directions[..., 1], directions[..., 0]))
    up = np.degrees(np.arcsin(np.clip(directions[..., 2], -1, 1)))
    away = np.abs((around - azimuth + 180) % 360 - 180)
    inside = (away < width / 2) & (np.abs(up - elevation) < height / 2)
    return inside[..., None].astype(np.float64)


def _ground(directions: Directions, first: tuple[float, ...], second: tuple[float, ...]) -> Directions:
    """Return tiles of two colors on a plane below, as seen from above it, fading with distance."""
    depth = np.minimum(directions[..., 2], -0.02)
    x, y = directions[..., 0] / -depth, directions[..., 1] / -depth
    tile = (np.floor(x * 1.2) + np.floor(y * 1.2)) % 2
    share = 0.5 + (tile - 0.5) * np.exp(-np.hypot(x, y) / 6)
    return np.array(first) + share[..., None] * (np.array(second) - np.array(first))


def _finished(base: Directions, lights: Directions) -> Float32[np.ndarray, "h w 3"]:
    """Bring the mean luminance of ``base`` to ``MEAN_LUMINANCE`` and lay the lamps over it."""
    rows = np.sin(np.pi * (np.arange(len(base)) + 0.5) / len(base))[:, None]
    mean = ((base @ _LUMINANCE) * rows).sum() / (rows.sum() * base.shape[1])
    return np.ascontiguousarray(base * (MEAN_LUMINANCE / mean) + lights, np.float32)


def noon(height: int = HEIGHT) -> Float32[np.ndarray, "h w 3"]:
    """Return a blue sky with clouds and a small bright sun over a tiled ground with hills around."""
    d = map_directions(height)
    up = d[..., 2:]
    sky = np.array([0.25, 0.5, 1.0]) + np.exp(-5 * np.maximum(up, 0)) * np.array([0.6, 0.45, 0.1])
    clouds = np.clip(_noise(d * [1, 1, 2.2], 2.5, 31) * 3 - 0.1, 0, 1) * (up > 0.05)
    sky = sky + clouds * (np.array([1.6, 1.6, 1.65]) - sky)
    hills = up < 0.12 + 0.16 * _noise(d * [1, 1, 0], 2.0, 7)
    below = np.where(up < -0.02, _ground(d, (0.42, 0.36, 0.28), (0.14, 0.12, 0.1)), [0.12, 0.2, 0.07])
    return _finished(np.where(hills, below, sky), _disc(d, 40, 52, 1.4) * np.array([520.0, 480.0, 420.0]))


def dusk(height: int = HEIGHT) -> Float32[np.ndarray, "h w 3"]:
    """Return an orange horizon under a violet sky, a low sun, and small lamps on the dark side."""
    d = map_directions(height)
    up = d[..., 2:]
    glow = np.clip(0.5 + 0.5 * d[..., :1], 0, 1) ** 2
    sky = np.array([0.16, 0.14, 0.34]) + np.exp(-4 * np.abs(up)) * (0.15 + glow) * np.array([1.5, 0.62, 0.2])
    sky *= 1 + 0.5 * _noise(d * [1, 1, 4], 2.0, 12)
    houses = _noise(np.round(d * [9, 9, 0]) / 9, 3.0, 3, octaves=1)
    low = up < np.where(d[..., :1] < 0.3, 0.16 + 0.3 * houses, 0.02)
    base = np.where(low, _ground(d, (0.05, 0.05, 0.06), (0.12, 0.1, 0.1)), sky)
    lights = _disc(d, -8, 9, 1.6) * np.array([220.0, 120.0, 50.0])
    for k in range(14):
        color = np.array([30.0, 24.0, 14.0]) if k % 2 else np.array([12.0, 18.0, 30.0])
        lights = lights + _disc(d, 95 + 13 * k, 5 + 5 * (k % 3), 1.3) * color
    return _finished(np.maximum(base, 0.01), lights)


def studio(height: int = HEIGHT) -> Float32[np.ndarray, "h w 3"]:
    """Return a grey room with soft boxes, coloured strips and a grid on its walls."""
    d = map_directions(height)
    around = np.degrees(np.arctan2(d[..., 1:2], d[..., :1]))
    up = np.degrees(np.arcsin(np.clip(d[..., 2:], -1, 1)))
    lines = ((around % 15 < 1.6) | (up % 15 < 1.6)).astype(np.float64)
    base = np.array([0.3, 0.31, 0.33]) * (1 - 0.65 * lines) * (1 + 0.3 * np.sin(np.radians(around)))
    base = np.where(up < -25, _ground(d, (0.5, 0.36, 0.22), (0.3, 0.2, 0.12)), base)
    lights = (
        6.0 * _window(d, 60, 40, 44, 26)
        + 9.0 * _window(d, -50, 55, 20, 34)
        + 4.0 * _window(d, 170, 25, 12, 50)
    )
    lights = lights * np.array([1.0, 0.97, 0.92])
    for azimuth, color in ((-110, (4.0, 0.6, 0.4)), (-140, (0.4, 1.2, 4.0)), (115, (0.6, 3.0, 0.8))):
        lights = lights + _window(d, azimuth, 15, 7, 46) * np.array(color)
    return _finished(base, lights)


SKIES: dict[str, Callable[[int], Float32[np.ndarray, "h w 3"]]] = {
    "noon": noon,
    "dusk": dusk,
    "studio": studio,
}
