"""Albedo of the objects in the synthetic scene, in linear light, from texture coordinates.

Every material takes positions (n, 3) in the object's own frame, in metres, and uv (n, 2), and returns colors
(n, 3) in linear light.
"""

import numpy as np
from jaxtyping import Float32

from octasplat.engine.dataset.synthetic.patterns import (
    box_mask,
    cell_noise,
    checkerboard,
    disc_pattern,
    gradient_noise,
    grey_column,
    grid_lines,
    lerp,
    linear_from_hex,
    octagon_pattern,
    sawtooth_mask,
    scale_points,
    smoothstep,
    text_mask,
)

TexturePoints = Float32[np.ndarray, "n 3"]
UvCoordinates = Float32[np.ndarray, "n 2"]
Colors = Float32[np.ndarray, "n 3"]


def _wood_grain(xyz: TexturePoints, light: str, dark: str, seed: int) -> Colors:
    """Return the albedo of wood whose fibres run along x."""
    wander = gradient_noise(scale_points(xyz, (1.2, 5.0, 5.0)), octaves=2, seed=seed)
    rings = 0.5 + 0.5 * np.sin(70 * xyz[:, 1] + 22 * xyz[:, 2] + 9 * wander)
    fibre = gradient_noise(scale_points(xyz, (5.0, 130.0, 130.0)), octaves=2, seed=seed + 1)
    return lerp(
        linear_from_hex(light),
        linear_from_hex(dark),
        np.clip(0.18 + 0.5 * rings * rings + 0.38 * fibre, 0, 1),
    )


def table_wood(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of oiled planks with dark seams."""
    plank = np.floor(xyz[:, 1] / 0.19 + 0.5)  # 0.19 m a plank
    shade = cell_noise(plank, np.zeros_like(plank), seed=3)
    # Each plank is cut from another place of the wood.
    shifted = xyz + np.stack([7 * shade, 3 * shade, 5 * shade], axis=1)
    colors = _wood_grain(shifted, "d9a066", "8a5428", seed=20) * grey_column(0.72 + 0.5 * shade)
    seam = np.abs(np.mod(xyz[:, 1] / 0.19 + 0.5, 1) - 0.5) > 0.485
    return lerp(colors, linear_from_hex("3a2212"), 0.85 * seam.astype(np.float32))


def pedestal_wood(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of dark turned wood, fibres upright."""
    return _wood_grain(np.ascontiguousarray(xyz[:, [2, 0, 1]]), "7a4a2c", "3b2012", seed=24)


def floor_tiles(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of terracotta and cream tiles, some with an octagon, all stained and grouted."""
    u, v = xyz[:, 0] / 0.4, xyz[:, 1] / 0.4
    tone = cell_noise(u, v, seed=5)
    odd = checkerboard(u, v)
    colors = lerp(linear_from_hex("c9704a"), linear_from_hex("e6d9bd"), odd)
    inlay = octagon_pattern(u, v, 0.3) - octagon_pattern(u, v, 0.24) + disc_pattern(u, v, 0.09)
    colors = lerp(colors, linear_from_hex("2f5d62"), inlay * odd)
    colors = lerp(colors, linear_from_hex("8a3d26"), octagon_pattern(u, v, 0.14) * (1 - odd))
    stain = gradient_noise(xyz * np.float32(6), octaves=4, seed=31)
    colors = colors * grey_column(0.82 + 0.26 * tone + 0.2 * stain)
    return lerp(colors, linear_from_hex("6d665c"), grid_lines(u, v, 0.035))


def _painting_albedo(index: int, u: np.ndarray, v: np.ndarray) -> Colors:
    """Return the albedo of eight different paintings, u and v in [0, 1] across the canvas."""
    flat = np.stack([u, v, np.full_like(u, index)], axis=1).astype(np.float32)
    if index == 0:  # hills at dusk, one behind another
        colors = lerp(linear_from_hex("f6c177"), linear_from_hex("3e5c9a"), smoothstep(0.35, 1.0, v))
        colors = lerp(colors, linear_from_hex("fff1c9"), box_mask(np.hypot(u - 0.7, v - 0.62), 0.0, 0.1))
        for k, shade in enumerate(("7d5a8c", "4b4a78", "2c3657", "18233a")):
            line = np.stack([3 * u + 9 * k, np.full_like(u, k), np.zeros_like(u)], axis=1).astype(np.float32)
            ridge = np.float32(0.52 - 0.13 * k) + 0.13 * gradient_noise(line, octaves=4, seed=40)
            colors = lerp(colors, linear_from_hex(shade), (v < ridge).astype(np.float32))
        return colors
    if index == 1:  # rings
        ring = np.floor(9 * np.hypot(u - 0.5, v - 0.5) + 0.25 * gradient_noise(flat * 5, octaves=2, seed=41))
        return lerp(linear_from_hex("f2e8cf"), linear_from_hex("bc4749"), np.mod(ring, 2)) * grey_column(
            1 - 0.05 * ring
        )
    if index == 2:  # letters
        ink = text_mask(8 * u, 5 * (v - 1), ["OCTAGON ", "PLATES  ", "SPLATS  ", "ORIGINAL"])
        return lerp(linear_from_hex("f4f1de"), linear_from_hex("1d3557"), ink)
    if index == 3:  # marble
        vein = np.abs(np.sin(9 * u + 6 * v + 4 * gradient_noise(flat * 3, octaves=5, seed=42)))
        return lerp(
            linear_from_hex("183a37"),
            linear_from_hex("efd6ac"),
            np.clip(1.2 - 2.2 * vein, 0, 1).astype(np.float32),
        )
    if index == 4:  # patchwork
        tone = cell_noise(6 * u, 6 * v, seed=43)
        colors = lerp(linear_from_hex("264653"), linear_from_hex("e9c46a"), smoothstep(0.2, 0.75, tone))
        colors = lerp(colors, linear_from_hex("e76f51"), (tone > 0.72).astype(np.float32))
        return lerp(colors, linear_from_hex("f8f4e3"), disc_pattern(6 * u, 6 * v, 0.22) * (tone < 0.4))
    if index == 5:  # waves
        wave = np.sin(40 * v + 5 * np.sin(9 * u) + 3 * gradient_noise(flat * 4, octaves=2, seed=44))
        return lerp(
            linear_from_hex("0b3954"), linear_from_hex("bfd7ea"), (0.5 + 0.5 * wave).astype(np.float32)
        )
    if index == 6:  # octagon mosaic
        tone = cell_noise(7 * u, 7 * v, seed=45)
        colors = lerp(linear_from_hex("f1faee"), linear_from_hex("6a994e"), tone)
        return lerp(linear_from_hex("33272a"), colors, octagon_pattern(7 * u, 7 * v, 0.46))
    spots = gradient_noise(flat * 9, octaves=3, seed=46)  # ink blots
    return lerp(linear_from_hex("faedcd"), linear_from_hex("6d2e46"), smoothstep(0.02, 0.1, spots))


def room_walls(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of panelled walls with wallpaper, paintings and a frieze; u has 10 m a side."""
    side = np.floor(uv[:, 0] / 10 + 0.5).astype(np.int32)
    u, v = uv[:, 0] - 10 * side.astype(np.float32), uv[:, 1]
    stripe = box_mask(np.mod(u / 0.24, 1), 0.0, 0.5)
    colors = lerp(linear_from_hex("9fb8ad"), linear_from_hex("c7d3bf"), stripe)
    motif = octagon_pattern(u / 0.24 - 0.25, v / 0.24, 0.2) - octagon_pattern(u / 0.24 - 0.25, v / 0.24, 0.1)
    colors = lerp(colors, linear_from_hex("e0a458"), motif)
    colors = colors * grey_column(1 + 0.12 * gradient_noise(xyz * np.float32(9), octaves=3, seed=33))
    wainscot = _wood_grain(
        np.ascontiguousarray(np.stack([v, u, 3 * side], axis=1).astype(np.float32)), "8c6a4f", "5b4032", 50
    )
    panel = grid_lines(u / 0.42, (v - 0.05) / 0.75, 0.09)
    colors = np.where((v < 0.8)[:, None], wainscot * grey_column(1 - 0.55 * panel), colors)
    colors = lerp(colors, linear_from_hex("efe6d5"), box_mask(v, 0.8, 0.86) + box_mask(v, 0.0, 0.08))
    frieze = box_mask(v, 2.5, 2.86)
    ink = text_mask(u / 0.17 + 0.5, (v - 2.82) / 0.36, ["OCTASPLAT "])
    colors = lerp(colors, lerp(linear_from_hex("274060"), linear_from_hex("f3d9a4"), ink), frieze)
    half_width, middle, half_height = 0.72, 1.68, 0.54
    frame = (np.abs(u) < half_width + 0.07) & (np.abs(v - middle) < half_height + 0.07)
    canvas = (np.abs(u) < half_width) & (np.abs(v - middle) < half_height)
    colors = lerp(colors, linear_from_hex("5a3e1b"), frame.astype(np.float32))
    for index in range(8):
        here = np.flatnonzero(canvas & (side == index))
        if len(here):
            across, up = (u[here] / half_width + 1) / 2, ((v[here] - middle) / half_height + 1) / 2
            weave = gradient_noise(scale_points(xyz[here], (60.0, 60.0, 60.0)), octaves=1, seed=34)
            colors[here] = _painting_albedo(index, across, up) * grey_column(1 + 0.1 * weave)
    return colors


def vase_glaze(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of white porcelain painted with blue bands."""
    turn, z = uv[:, 0], xyz[:, 2]
    paint = gradient_noise(xyz * np.float32(35), octaves=3, seed=60)
    colors = np.broadcast_to(linear_from_hex("eee8dc"), xyz.shape) * grey_column(1 + 0.07 * paint)
    blue = lerp(linear_from_hex("1f3f87"), linear_from_hex("4a78c0"), np.clip(0.5 + 0.8 * paint, 0, 1))
    bands = (
        box_mask(z, 0.03, 0.045)
        + box_mask(z, 0.105, 0.115)
        + box_mask(z, 0.335, 0.35)
        + box_mask(z, 0.46, 0.47)
    )
    bands = bands + box_mask(z, 0.045, 0.105) * sawtooth_mask(24 * turn, (z - 0.05) / 0.05)
    bands = bands + box_mask(z, 0.35, 0.37) * (1 - disc_pattern(30 * turn, (z - 0.35) / 0.02, 0.33))
    belly = box_mask(z, 0.125, 0.325)
    petals = np.cos(2 * np.pi * 8 * turn) * 0.5 + 0.5
    height = np.abs(z - 0.225) / 0.1
    flower = (
        (height < petals).astype(np.float32) - (height < 0.72 * petals - 0.08) + (height < 0.4 * petals - 0.1)
    )
    leaf = (
        (height > 1 - 0.6 * (1 - petals)) & (gradient_noise(xyz * np.float32(50), octaves=2, seed=61) > 0.05)
    ).astype(np.float32)
    bands = bands + belly * np.clip(flower + leaf, 0, 1)
    bands = bands + box_mask(z, 0.38, 0.455) * sawtooth_mask(16 * turn, (z - 0.38) / 0.075) * sawtooth_mask(
        48 * turn, (z - 0.36) / 0.09
    )
    colors = lerp(colors, blue, np.clip(bands, 0, 1).astype(np.float32))
    return lerp(colors, linear_from_hex("c8963e"), (z > 0.492).astype(np.float32))


def knot_glaze(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of flecked bands that wind around the tube."""
    phase = 30 * uv[:, 0] + 2 * uv[:, 1]
    band = np.floor(np.mod(phase, 3))
    colors = lerp(linear_from_hex("d62839"), linear_from_hex("f6b92b"), (band == 1).astype(np.float32))
    colors = lerp(colors, linear_from_hex("1d6a96"), (band == 2).astype(np.float32))
    fleck = smoothstep(0.5, 0.6, gradient_noise(xyz * np.float32(90), octaves=2, seed=62))
    colors = lerp(colors, linear_from_hex("fbf3e4"), 0.75 * fleck)
    return lerp(colors, linear_from_hex("161616"), box_mask(np.mod(phase, 1), 0.0, 0.07))


def tower_bricks(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of small bricks with mortar, and a band of letters on each side."""
    u, v = uv[:, 0], uv[:, 1]
    course = v / 0.032
    along = u / 0.07 + 0.5 * np.mod(np.floor(course), 2)  # every second course is offset by half a brick
    tone = cell_noise(along, course, seed=63)
    colors = lerp(linear_from_hex("b9573b"), linear_from_hex("d9a07a"), tone)
    colors = lerp(colors, linear_from_hex("6f7f86"), (tone > 0.86).astype(np.float32))
    colors = colors * grey_column(0.95 + 0.35 * gradient_noise(xyz * np.float32(45), octaves=3, seed=64))
    mortar = np.maximum(box_mask(np.mod(course, 1), 0.0, 0.13), box_mask(np.mod(along, 1), 0.0, 0.06))
    colors = lerp(colors, linear_from_hex("cfc6b4"), mortar)
    sign = box_mask(v, 0.30, 0.40)
    # From the middle of a side, in meters: u has 10 m a side
    across = np.mod(u + 5, 10) - 5
    ink = text_mask(across / 0.042 + 2.5, (v - 0.386) / 0.1, ["SPLAT"]) * box_mask(across, -0.104, 0.104)
    return lerp(colors, lerp(linear_from_hex("f5efe0"), linear_from_hex("22333b"), ink), sign)


def boulder_stone(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of speckled granite with lichen on its upper side."""
    body = gradient_noise(xyz * np.float32(9), octaves=4, seed=65)
    colors = lerp(linear_from_hex("8d8a83"), linear_from_hex("4f4b48"), np.clip(0.5 + 0.9 * body, 0, 1))
    speck = gradient_noise(xyz * np.float32(110), octaves=2, seed=66)
    colors = lerp(colors, linear_from_hex("e4ddd0"), 0.8 * smoothstep(0.36, 0.5, speck))
    colors = lerp(colors, linear_from_hex("1f1d1d"), 0.7 * smoothstep(-0.36, -0.5, speck))
    patches = gradient_noise(xyz * np.float32(13), octaves=4, seed=67) + 2.2 * (xyz[:, 2] - 0.06)
    lichen = lerp(linear_from_hex("6f7d43"), linear_from_hex("b9a548"), np.clip(0.5 + speck, 0, 1))
    return lerp(colors, lichen, 0.85 * smoothstep(0.2, 0.32, patches))


def cube_paint(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of a toy block: a checkerboard whose faces carry large letters in octagons."""
    axis = np.argmax(np.abs(xyz), axis=1)
    rows = np.arange(len(xyz))
    first, second = xyz[rows, (axis + 1) % 3], xyz[rows, (axis + 2) % 3]
    sign = np.sign(xyz[rows, axis])
    # Letters read upright on the sides: horizontal to the right as seen from outside, z upwards.
    upright = axis != 2
    across = np.where(axis == 0, first * sign, np.where(axis == 1, -second * sign, first))
    up = np.where(axis == 0, second, np.where(axis == 1, first, second))
    up = np.where(upright, xyz[:, 2], up)
    colors = lerp(
        linear_from_hex("f2e9e4"), linear_from_hex("2a9d8f"), checkerboard(across / 0.045, up / 0.045)
    )
    colors = colors * grey_column(0.95 + 0.2 * gradient_noise(xyz * np.float32(40), octaves=3, seed=68))
    medal = octagon_pattern(across / 0.4 + 0.5, up / 0.4 + 0.5, 0.27)
    colors = lerp(colors, linear_from_hex("fdf6e3"), medal)
    face = (2 * axis + (sign > 0)).astype(np.float32)  # a letter a face
    ink = text_mask((across + 0.065) / 0.156 + np.clip(face, 0, 5), (up - 0.075) / 0.215, ["OCTAGS"])
    near = (np.abs(across) < 0.066) & (np.abs(up) < 0.08)
    return lerp(colors, linear_from_hex("d1495b"), ink * near * medal)


def book_cloth(xyz: TexturePoints, uv: UvCoordinates) -> Colors:
    """Return the albedo of a closed book on its side: cloth covers with a title, and pages between."""
    x, y, z = xyz[:, 0], xyz[:, 1], xyz[:, 2]
    weave = checkerboard(x / 0.004, y / 0.004) * 0.12 + 0.9
    colors = np.broadcast_to(linear_from_hex("7b2d26"), xyz.shape) * grey_column(weave)
    label = box_mask(np.abs(x), 0.0, 0.135) * box_mask(np.abs(y), 0.0, 0.185)
    colors = lerp(colors, linear_from_hex("efe3c8"), label)
    title = (
        text_mask((x + 0.12) / 0.03, (y - 0.165) / 0.06, ["OCTAGONS"])
        * box_mask(y, 0.12, 0.166)
        * box_mask(x, -0.12, 0.12)
    )
    prose = ["A SPLAT IS A", "SPOT ON A PLANE", "PLUS ITS COLOR", "AN OCTAGON IS"]
    prose += ["ITS OUTLINE", "TRACE IT AGAIN", "UNTIL IT SITS", "IN ITS PLACE"]
    print_ = (
        text_mask((x + 0.12) / 0.016, (y - 0.1) / 0.034, prose)
        * box_mask(y, -0.17, 0.1)
        * box_mask(x, -0.12, 0.12)
    )
    colors = lerp(colors, linear_from_hex("2b2118"), label * np.clip(title + print_, 0, 1))
    pages = lerp(
        linear_from_hex("f3ead7"),
        linear_from_hex("b7a98c"),
        (np.sin(z * 1600) * 0.5 + 0.5).astype(np.float32),
    )
    inside = (z > 0.008) & (z < 0.062) & (x > -0.155)
    return np.where(inside[:, None], pages, colors)
