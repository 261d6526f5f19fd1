"""Albedo of a street: houses, roofs, ground and trees; arguments as in :mod:`.albedo`."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from octasplat.engine.dataset.synthetic.albedo import Colors, TexturePoints, UvCoordinates
from octasplat.engine.dataset.synthetic.patterns import (
    box_mask,
    cell_noise,
    gradient_noise,
    grey_column,
    grid_lines,
    lerp,
    linear_from_hex,
    scale_points,
    smoothstep,
    text_mask,
)

SIDE_STEP = 100.0
"""By so much u of a house's walls differs from side to side; the first side faces the street."""
WINDOW_STEP, STOREY = 2.2, 3.0
"""Metres from window to window, along and up."""
_PLASTERS = ("d9c3a0", "b7c4c9", "c98d6b", "e3ddcf", "9fae8c", "d8b46a", "a9929f", "c7b7a3")
_WOODS = ("7a2e25", "274156", "3f5a36")
_FRAMES = ("f4f1ea", "3c4a3e", "5b3a29", "dfe6ea")
DISTINCT_FROM = 16
"""From this number on no two houses are alike: each has colors, signs and windows of its own."""
_SIGNS = ("OCTAGON", "SPLAT", "GALLERIA", "PASTA", "CEREAL", "REGAL", "ORIGINAL", "LOGIC")


class _Look(NamedTuple):
    """Colors of a house, the word of its sign, if it has one, and the size of its door's panels."""

    plaster: Colors
    frame: Colors
    door: Colors
    is_brick: bool
    word: str | None
    panel_m: tuple[float, float]


def _look(number: int) -> _Look:
    if number < DISTINCT_FROM:
        plaster = linear_from_hex(_PLASTERS[number % 8])
        frame, door = linear_from_hex(_FRAMES[number % 4]), linear_from_hex(_WOODS[number % 3])
        return _Look(plaster, frame, door, number % 3 == 1, _SIGNS[number % 8], (0.6, 1.15))
    random = np.random.default_rng(number)
    first, second = (linear_from_hex(str(random.choice(_PLASTERS))) for _ in range(2))
    return _Look(
        first + (second - first) * np.float32(random.uniform()),
        linear_from_hex(str(random.choice(_FRAMES))),
        linear_from_hex(str(random.choice(_WOODS))),
        bool(random.uniform() < 0.33),
        None,
        (float(random.uniform(0.3, 0.6)), float(random.uniform(0.6, 1.15))),
    )


def facade(number: int, storeys: int) -> Callable[[TexturePoints, UvCoordinates], Colors]:
    """Return the material of the walls of a house: plaster or bricks, windows, a door and a sign.

    Walls are whole window steps wide, so that no window is cut; above the storeys there are none.
    """
    look = _look(number)
    frame = look.frame

    def material(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
        side = np.floor(uv[:, 0] / SIDE_STEP)
        u, v = uv[:, 0] - SIDE_STEP * side, uv[:, 1]
        stain = gradient_noise(scale_points(xyz, (0.9, 0.9, 0.5)), octaves=4, seed=100 + number)
        grain = gradient_noise(xyz * np.float32(9), octaves=3, seed=200 + number)
        colors = np.broadcast_to(look.plaster, xyz.shape) * grey_column(0.86 + 0.24 * stain + 0.16 * grain)
        if look.is_brick:
            colors = _bricks(u, v, colors, number)
        base = box_mask(v, 0.0, 0.6)
        colors = lerp(colors, linear_from_hex("77716a") * grey_column(0.9 + 0.4 * grain), base)
        colors = _windows(colors, u, np.where(v < STOREY * storeys, v, 0), side, frame, number)
        is_front = (side == 0).astype(np.float32)
        door = box_mask(u, 5.0, 6.2) * box_mask(v, 0.0, 2.3) * is_front
        panel = grid_lines(u / look.panel_m[0] - 0.333, v / look.panel_m[1], 0.14)
        wood = lerp(look.door, frame, 0.8 * panel)
        colors = lerp(colors, wood * grey_column(0.9 + 0.3 * grain), door)
        board = box_mask(u, 3.4, 7.8) * box_mask(v, 2.5, 2.95) * is_front
        sign = _blots(xyz, number) if look.word is None else _letters(u, v, look.word)
        return lerp(colors, sign, board)

    return material


def _letters(u: np.ndarray, v: np.ndarray, word: str) -> Colors:
    """Return a sign with a word in its middle."""
    start = 5.6 - 0.25 * len(word)
    ink = text_mask((u - start) / 0.5, (v - 2.9) / 0.5, [word])
    ink = ink * box_mask(u, start, start + 0.5 * len(word))
    return lerp(linear_from_hex("20303c"), linear_from_hex("f3d27a"), ink)


def _blots(xyz: TexturePoints, number: int) -> Colors:
    """Return a sign with a painting like no other one's; letters would be alike on several."""
    blots = gradient_noise(xyz * np.float32(3), octaves=4, seed=3000 + number)
    return lerp(linear_from_hex("20303c"), linear_from_hex("f3d27a"), smoothstep(0.0, 0.1, blots))


def _bricks(u: np.ndarray, v: np.ndarray, colors: Colors, number: int) -> Colors:
    course = v / 0.12
    along = u / 0.3 + 0.5 * np.mod(np.floor(course), 2)
    tone = cell_noise(along, course, seed=number)
    colors = colors * grey_column(0.7 + 0.5 * tone)
    mortar = np.maximum(box_mask(np.mod(course, 1), 0.0, 0.14), box_mask(np.mod(along, 1), 0.0, 0.06))
    return lerp(colors, linear_from_hex("c9c1b2"), 0.7 * mortar)


def _windows(
    colors: Colors, u: np.ndarray, v: np.ndarray, side: np.ndarray, frame: np.ndarray, number: int
) -> Colors:
    """Return the wall with windows: frame, bars, panes that are darker above, some with curtains."""
    across, up = np.mod(u, WINDOW_STEP), np.mod(v, STOREY)
    if number >= DISTINCT_FROM:
        across, up = _irregular(across, up, u, v + 7 * STOREY * side, number)
    outside = box_mask(across, 0.5, 1.7) * box_mask(up, 0.95, 2.45)
    inside = box_mask(across, 0.6, 1.6) * box_mask(up, 1.05, 2.35)
    tone = cell_noise(u / WINDOW_STEP, v / STOREY + 7 * side, seed=300 + number)
    glass = lerp(linear_from_hex("5d7386"), linear_from_hex("1d2730"), (up - 1.05) / np.float32(1.3))
    glass = glass * grey_column(0.7 + 0.6 * tone)
    pleats = 0.75 + 0.25 * np.sin(55 * across)
    curtain = linear_from_hex("e6dcc6") * grey_column(pleats)
    drawn = (tone > 0.55) * (np.abs(across - 1.1) > 0.5 * (1.25 - tone))
    glass = lerp(glass, curtain, drawn.astype(np.float32))
    bars = np.maximum(box_mask(across, 1.07, 1.13), box_mask(up, 1.85, 1.91))
    glass = lerp(glass, frame, bars)
    colors = lerp(colors, frame, outside)
    colors = lerp(colors, glass, inside)
    sill = box_mask(across, 0.4, 1.8) * box_mask(up, 0.86, 0.95)
    return lerp(colors, linear_from_hex("a8a196"), sill)


def _irregular(
    across: np.ndarray, up: np.ndarray, u: np.ndarray, v: np.ndarray, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return places in a window, metres, of windows that are moved and stretched, each by other amounts."""

    def random(kind: int) -> np.ndarray:
        return cell_noise(u / WINDOW_STEP, v / STOREY, seed=1000 + 10 * number + kind) - np.float32(0.5)

    across = 1.1 + (across - 1.1 - 0.3 * random(0)) / (np.float32(0.95) + 0.4 * random(1))
    up = 1.7 + (up - 1.7 - 0.4 * random(2)) / (np.float32(0.95) + 0.3 * random(3))
    return across, up


def roof_tiles(number: int) -> Callable[[TexturePoints, UvCoordinates], Colors]:
    """Return the material of a roof: rows of rounded tiles of changing tone."""
    light, dark = (("b5573a", "6f2f22"), ("6d7278", "3b4046"), ("8a6a4a", "4c3826"))[number % 3]

    def material(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
        row = uv[:, 1] / 0.28
        place = uv[:, 0] / 0.22 + 0.5 * np.mod(np.floor(row), 2)
        tone = cell_noise(place, row, seed=400 + number)
        moss = gradient_noise(xyz * np.float32(0.8), octaves=4, seed=500 + number)
        colors = lerp(linear_from_hex(light), linear_from_hex(dark), np.clip(tone, 0, 1))
        colors = lerp(colors, linear_from_hex("6b7440"), 0.6 * smoothstep(0.2, 0.45, moss))
        bow = np.abs(np.mod(place, 1) - 0.5)
        edge = (np.mod(row, 1) < 0.22 + 0.9 * bow * bow).astype(np.float32)
        return colors * grey_column(1 - 0.5 * edge)

    return material


def street_ground(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of the ground: asphalt with marks, kerbs, paved ways, and grass behind."""
    x, y = xyz[:, 0], np.abs(xyz[:, 1])
    fine = gradient_noise(xyz * np.float32(14), octaves=3, seed=71)
    wide = gradient_noise(xyz * np.float32(0.5), octaves=4, seed=72)
    colors = linear_from_hex("5d5d60") * grey_column(0.85 + 0.5 * fine + 0.4 * wide)
    patch = cell_noise(x / 7.3, xyz[:, 1] / 2.1, seed=73)
    colors = colors * grey_column(np.where(patch > 0.8, 0.62, 1.0))
    dashes = box_mask(y, 0.0, 0.08) * box_mask(np.mod(x, 4.0), 0.0, 2.0)
    colors = lerp(colors, linear_from_hex("e8e4d8"), dashes * np.clip(0.9 + 0.8 * fine, 0, 1))
    crossing = box_mask(np.mod(x, 28.0), 12.0, 15.0) * box_mask(np.mod(y + 0.3, 1.2), 0.0, 0.6)
    colors = lerp(colors, linear_from_hex("ded9cb"), crossing * box_mask(y, 0.0, 3.4))
    slabs = linear_from_hex("a49c8e") * grey_column(
        0.75 + 0.4 * cell_noise(x / 0.6, xyz[:, 1] / 0.6, seed=74) + 0.3 * fine
    )
    slabs = lerp(slabs, linear_from_hex("5f5a52"), grid_lines(x / 0.6, xyz[:, 1] / 0.6, 0.05))
    colors = lerp(colors, slabs, box_mask(y, 3.6, 7.0))
    kerb = linear_from_hex("c4beb2") * grey_column(0.9 + 0.3 * cell_noise(x / 1.1, y * 0, seed=75))
    colors = lerp(colors, kerb, box_mask(y, 3.4, 3.6))
    blades = gradient_noise(scale_points(xyz, (5.0, 5.0, 5.0)), octaves=4, seed=76)
    grass = lerp(linear_from_hex("5d7a33"), linear_from_hex("a59a5a"), np.clip(0.4 + blades + wide, 0, 1))
    return lerp(colors, grass, (y >= 7.0).astype(np.float32))


def painted(
    material: Callable[[TexturePoints, UvCoordinates], Colors], number: int
) -> Callable[[TexturePoints, UvCoordinates], Colors]:
    """Return ``material``, whose ``xyz`` span about half a unit, under paint that differs with ``number``."""
    paint = linear_from_hex(_PLASTERS[number % 8])

    def blotted(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
        wide = gradient_noise(xyz * np.float32(9), octaves=5, seed=2000 + number)
        return lerp(material(xyz, uv), paint * grey_column(0.5 + 0.8 * wide), smoothstep(0.0, 0.1, wide))

    return blotted


def leaves(number: int) -> Callable[[TexturePoints, UvCoordinates], Colors]:
    """Return the material of a crown of leaves."""
    light, dark = (("8fa845", "2f4a1c"), ("b3a03a", "5a5a1e"), ("6f9a4f", "23401f"))[number % 3]

    def material(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
        clumps = gradient_noise(xyz * np.float32(2.2), octaves=2, seed=600 + number)
        leaf = gradient_noise(xyz * np.float32(11), octaves=3, seed=700 + number)
        colors = lerp(linear_from_hex(dark), linear_from_hex(light), np.clip(0.45 + 0.9 * leaf, 0, 1))
        return colors * grey_column(0.8 + 0.6 * clumps)

    return material
