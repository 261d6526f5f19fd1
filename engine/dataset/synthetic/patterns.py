"""Procedural patterns: pure functions of texture coordinates, evaluated wherever a ray hits.

Patterns return numbers in [0, 1] (noise in about [-1, 1]); colors are linear light.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.dataset.synthetic.kernels import noise

_FONT = {
    "A": "01110 10001 10001 11111 10001 10001 10001",
    "C": "01111 10000 10000 10000 10000 10000 01111",
    "E": "11111 10000 10000 11110 10000 10000 11111",
    "G": "01111 10000 10000 10011 10001 10001 01111",
    "I": "01110 00100 00100 00100 00100 00100 01110",
    "L": "10000 10000 10000 10000 10000 10000 11111",
    "N": "10001 11001 10101 10101 10011 10001 10001",
    "O": "01110 10001 10001 10001 10001 10001 01110",
    "P": "11110 10001 10001 11110 10000 10000 10000",
    "R": "11110 10001 10001 11110 10100 10010 10001",
    "S": "01111 10000 10000 01110 00001 00001 11110",
    "T": "11111 00100 00100 00100 00100 00100 00100",
    "U": "10001 10001 10001 10001 10001 10001 01110",
    " ": "00000 00000 00000 00000 00000 00000 00000",
}
_LETTERS = "".join(_FONT)


def _font_bitmaps() -> UInt8[np.ndarray, "letters 7 5"]:
    rows = [[[int(bit) for bit in row] for row in bitmap.split()] for bitmap in _FONT.values()]
    return np.array(rows, dtype=np.uint8)


_BITMAPS = _font_bitmaps()


def linear_from_hex(color: str) -> Float32[np.ndarray, "3"]:
    """Return the linear light of a display color written as ``rrggbb``."""
    srgb = np.array([int(color[k : k + 2], 16) for k in (0, 2, 4)]) / 255
    return srgb_to_linear(srgb).astype(np.float32)


def lerp(
    first: Float32[np.ndarray, "... 3"],
    second: Float32[np.ndarray, "... 3"],
    amount: Float32[np.ndarray, " n"],
) -> Float32[np.ndarray, "n 3"]:
    """Interpolate linearly between ``first`` (amount 0) and ``second`` (amount 1)."""
    return first + (second - first) * amount[:, None]


def smoothstep(low: float, high: float, values: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    """Return 0 below ``low``, 1 above ``high``, smooth between; ``low`` above ``high`` reverses it."""
    t = np.clip((values - np.float32(low)) * np.float32(1 / (high - low)), 0, 1)
    return t * t * (3 - 2 * t)


def gradient_noise(
    points: Float32[np.ndarray, "n 3"], octaves: int = 1, seed: int = 0
) -> Float32[np.ndarray, " n"]:
    """Return fractal gradient noise; a cell of the coarsest octave has the size 1."""
    out = np.empty(len(points), np.float32)
    noise.fractal_noise(np.ascontiguousarray(points), octaves, seed, out)
    return out


def cell_noise(
    first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"], seed: int = 0
) -> Float32[np.ndarray, " n"]:
    """Return a random number in [0, 1) for the integer cell that contains each (first, second)."""
    cells = np.stack([np.floor(first), np.floor(second), np.zeros_like(first)], axis=1).astype(np.int32)
    out = np.empty(len(cells), np.float32)
    noise.hash_cells(cells, seed, out)
    return out


def box_mask(values: Float32[np.ndarray, " n"], low: float, high: float) -> Float32[np.ndarray, " n"]:
    """Return 1 between ``low`` and ``high``, else 0."""
    return ((values >= low) & (values < high)).astype(np.float32)


def checkerboard(
    first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"]
) -> Float32[np.ndarray, " n"]:
    """Return 0 and 1 on alternate unit squares."""
    return np.mod(np.floor(first) + np.floor(second), 2)


def grid_lines(
    first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"], width: float
) -> Float32[np.ndarray, " n"]:
    """Return 1 in lines of ``width`` along the borders of unit squares, else 0."""
    reach = np.maximum(np.abs(np.mod(first, 1) - 0.5), np.abs(np.mod(second, 1) - 0.5))
    return (reach > 0.5 - 0.5 * width).astype(np.float32)


def sawtooth_mask(
    first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"]
) -> Float32[np.ndarray, " n"]:
    """Return 1 below a sawtooth of unit period and unit height, else 0."""
    return (second < np.abs(2 * np.mod(first, 1) - 1)).astype(np.float32)


def disc_pattern(
    first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"], radius: float
) -> Float32[np.ndarray, " n"]:
    """Return 1 in discs of ``radius`` at the centres of unit squares, else 0."""
    distance = np.hypot(np.mod(first, 1) - 0.5, np.mod(second, 1) - 0.5)
    return (distance < radius).astype(np.float32)


def octagon_pattern(
    first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"], radius: float
) -> Float32[np.ndarray, " n"]:
    """Return 1 in regular octagons of apothem ``radius`` at the centres of unit squares, else 0."""
    x, y = np.abs(np.mod(first, 1) - 0.5), np.abs(np.mod(second, 1) - 0.5)
    # The slanted sides have the same apothem.
    reach = np.maximum(np.maximum(x, y), (x + y) * np.float32(np.sqrt(0.5)))
    return (reach < radius).astype(np.float32)


def text_mask(
    first: Float32[np.ndarray, " n"], second: Float32[np.ndarray, " n"], lines: Sequence[str]
) -> Float32[np.ndarray, " n"]:
    """Return 1 on the strokes of capital letters, else 0.

    A letter fills one unit of ``first``; lines are one unit of ``second`` apart, the first at the top
    (``second`` just below 0), the text repeating in both directions.
    """
    width = max(len(line) for line in lines)
    page: Int[np.ndarray, "l w"] = np.array(
        [[_LETTERS.index(c) for c in line.ljust(width)] for line in lines]
    )
    line = np.floor(-second).astype(np.int32) % len(lines)
    place = np.floor(first).astype(np.int32) % width
    # A cell is six columns by ten rows of dots: five and seven for the letter, the rest is spacing.
    column = np.floor(np.mod(first, 1) * 6).astype(np.int32)
    row = np.floor(np.mod(-second, 1) * 10).astype(np.int32)
    ink = _BITMAPS[page[line, place], np.minimum(row, 6), np.minimum(column, 4)]
    return (ink * ((row < 7) & (column < 5))).astype(np.float32)


def scale_points(points: Float32[np.ndarray, "n 3"], factors: Sequence[float]) -> Float32[np.ndarray, "n 3"]:
    """Return ``points`` with each coordinate multiplied, to stretch a solid texture."""
    return points * np.asarray(factors, np.float32)


def grey_column(values: Float[np.ndarray, " n"]) -> Float32[np.ndarray, "n 1"]:
    """Return numbers as a column that scales colors."""
    return values.astype(np.float32)[:, None]
