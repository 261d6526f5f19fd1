"""Parsing of OBJ: whole blocks of the file are sorted by kind of line and parsed at once."""

import codecs
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.geometry.polygons import fan_places, triangle_places

BLOCK_BYTES = 1 << 22
NEWLINE, SPACE, TAB = 10, 32, 9  # every other white space lies below the space
MAX_HEADER_LINES = 64
MAX_LINE_BYTES = 1 << 26
DIGIT_LINES = 2000
_INDENT = re.compile(rb"^[ \t]+", re.MULTILINE)


@dataclass
class ObjParts:
    """Parts of a file that were read so far, block by block."""

    positions: list[np.ndarray] = field(default_factory=list)
    uv: list[np.ndarray] = field(default_factory=list)
    normals: list[np.ndarray] = field(default_factory=list)
    triangles: list[np.ndarray] = field(default_factory=list)
    triangle_uv: list[np.ndarray] = field(default_factory=list)
    triangle_normals: list[np.ndarray] = field(default_factory=list)
    comments: list[str] = field(default_factory=list)
    decimals: int = 0
    vertex_count: int = 0
    uv_count: int = 0
    normal_count: int = 0
    triangle_count: int = 0
    with_materials: bool = False
    colors: list[np.ndarray] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)
    material_uses: list[tuple[int, str]] = field(default_factory=list)
    polygons: dict[int, list[np.ndarray]] = field(default_factory=dict)
    """First triangle of each polygon, by its number of corners."""


def read_blocks(handle: IO[bytes]) -> Iterator[bytes]:
    """Yield the file in blocks that end at the end of a line, with the lines that go on after a backslash."""
    rest = handle.read(len(codecs.BOM_UTF8)).removeprefix(codecs.BOM_UTF8)
    while chunk := handle.read(BLOCK_BYTES):
        data = rest + chunk
        end = data.rfind(b"\n")
        while end >= 0 and data[max(0, end - 2) : end].removesuffix(b"\r").endswith(b"\\"):
            end = data.rfind(b"\n", 0, end)
        if end >= 0:
            yield data[: end + 1]
        rest = data[end + 1 :]
        if len(rest) > MAX_LINE_BYTES:
            raise SceneFileError(f"{handle.name}: has a line of more than {MAX_LINE_BYTES >> 20} MiB.")
    if rest:
        yield rest + b"\n"


def parse_block(path: Path, block: bytes, parts: ObjParts) -> None:
    """Add what a block of lines says to ``parts``."""
    if not parts.positions:
        for line in block.split(b"\n", MAX_HEADER_LINES)[:MAX_HEADER_LINES]:
            if line.startswith(b"#"):
                parts.comments.append(line[1:].decode("utf-8", "replace").strip())
    # A backslash at the end of a line continues it.
    if b"\\\n" in block or b"\\\r\n" in block:
        block = block.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    if _INDENT.search(block):
        block = _INDENT.sub(b"", block)
    data = np.frombuffer(block, np.uint8)
    ends = np.flatnonzero(data == NEWLINE) + 1
    starts = np.concatenate([[0], ends[:-1]])
    first, second = data[starts], data[np.minimum(starts + 1, len(data) - 1)]
    third = data[np.minimum(starts + 2, len(data) - 1)]
    blank = (second == SPACE) | (second == TAB)
    is_position = (first == ord("v")) & blank
    is_spaced = (third == SPACE) | (third == TAB)
    is_uv = (first == ord("v")) & (second == ord("t")) & is_spaced
    is_normal = (first == ord("v")) & (second == ord("n")) & is_spaced
    is_face = (first == ord("f")) & blank
    lengths = ends - starts
    # What comes before each line, from which its relative numbers count back.
    before = np.stack(
        [
            parts.vertex_count + np.cumsum(is_position),
            parts.uv_count + np.cumsum(is_uv),
            parts.normal_count + np.cumsum(is_normal),
        ],
        axis=1,
    )
    if is_position.any():
        text = _select_lines(data, is_position, lengths)
        # Numbers contain none of the letters that are taken out.
        values = _parse_number_rows(path, text.translate(None, b"v"), int(is_position.sum()), "v")
        if values.shape[1] < 3:
            raise SceneFileError(f"{path}: a line 'v' has fewer than three numbers.")
        parts.positions.append(values[:, :3].copy())  # without the colors behind them
        if parts.with_materials and values.shape[1] >= 6:
            parts.colors.append(values[:, 3:6].astype(np.float32))
        parts.vertex_count += len(values)
        # The first lines tell how many decimals the file keeps.
        for line in text.split(b"\n", DIGIT_LINES)[:DIGIT_LINES]:
            words = line.split()[1:4]
            parts.decimals = max([parts.decimals, *(len(word.partition(b".")[2]) for word in words)])
    if is_uv.any():
        text = _select_lines(data, is_uv, lengths).translate(None, b"vt")
        parts.uv.append(_parse_number_rows(path, text, int(is_uv.sum()), "vt")[:, :2].astype(np.float32))
        parts.uv_count += int(is_uv.sum())
    if is_normal.any():
        if parts.with_materials:
            text = _select_lines(data, is_normal, lengths).replace(b"vn", b"")
            parts.normals.append(_parse_normals(path, text, int(is_normal.sum())))
        parts.normal_count += int(is_normal.sum())
    spans = [(0, len(starts), "")]
    if parts.with_materials:
        _parse_libraries(block, parts)
        spans = _usemtl_ranges(block, starts, first == ord("u"))
    for begin, end, material in spans:
        if material:
            parts.material_uses.append((parts.triangle_count, material))
        chosen = is_face[begin:end]
        if chosen.any():
            lines = data[starts[begin] : ends[end - 1]]
            text = _select_lines(lines, chosen, lengths[begin:end])
            _parse_faces(path, text, before[begin:end][chosen], parts)


def _parse_libraries(block: bytes, parts: ObjParts) -> None:
    for line in re.findall(rb"^mtllib[ \t]+(.+)$", block, re.MULTILINE):
        parts.libraries.append(line.decode("utf-8", "replace").strip())


def _usemtl_ranges(block: bytes, starts: np.ndarray, candidates: np.ndarray) -> list[tuple[int, int, str]]:
    """Yield the lines of a block from one ``usemtl`` to the next, with the name of the material."""
    spans = [(0, len(starts), "")]
    for row in np.flatnonzero(candidates):
        line = block[starts[row] : block.index(b"\n", starts[row])].split(maxsplit=1)
        if len(line) == 2 and line[0] == b"usemtl":
            begin, _, before = spans.pop()
            spans += [
                (begin, int(row), before),
                (int(row), len(starts), line[1].decode("utf-8", "replace").strip()),
            ]
    return spans


def _select_lines(data: np.ndarray, chosen: np.ndarray, lengths: np.ndarray) -> bytes:
    return data.tobytes() if chosen.all() else data[np.repeat(chosen, lengths)].tobytes()


def _parse_number_rows(path: Path, text: bytes, lines: int, keyword: str) -> np.ndarray:
    """Parse ``lines`` lines of numbers to rows; all lines must have the same count."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # numpy's way to say that it met no number
        try:
            values = np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError) as error:
            raise SceneFileError(f"{path}: a line '{keyword}' holds something that is no number.") from error
    words = len(text[: text.index(b"\n")].split())
    if len(values) != lines * words or _is_ragged(text, words):
        return _ragged_numbers(path, text, keyword)
    return values.reshape(lines, words)


def _parse_normals(path: Path, text: bytes, lines: int) -> Float32[np.ndarray, "n 3"]:
    """Parse normals; what is no direction, as some programs write it, is not-a-number."""
    try:
        values = _parse_number_rows(path, text, lines, "vn")[:, :3].astype(np.float32)
    except (SceneFileError, ValueError):
        values = np.zeros((lines, 0), np.float32)
    return values if values.shape == (lines, 3) else np.full((lines, 3), np.nan, np.float32)


def _ragged_numbers(path: Path, text: bytes, keyword: str) -> np.ndarray:
    """Parse as many columns as the shortest line has (some programs color only part of the vertices)."""
    rows = [line.split() for line in text.split(b"\n") if line.strip()]
    width = min(len(row) for row in rows)
    if width == 0:
        raise SceneFileError(f"{path}: a line '{keyword}' is empty.")
    return np.array([[float(word) for word in row[:width]] for row in rows])


def _parse_faces(path: Path, text: bytes, before: Int64[np.ndarray, "f 3"], parts: ObjParts) -> None:
    """Parse faces as triangle fans, with texture coordinates and normals of their corners where given.

    Args:
        path: named in errors.
        text: the lines of the faces.
        before: vertices, texture coordinates and normals that come before each of these lines.
        parts: gets the triangles.
    """
    lines = len(before)
    text = text.replace(b"//", b"/0/")  # 0 stands for none
    sample = text[: text.index(b"\n")].split()[1:]
    slashes = {word.count(b"/") for word in sample}
    spaces, words_per_line = text.count(b"/"), len(sample)
    uniform = len(slashes) == 1 and spaces == lines * words_per_line * next(iter(slashes))
    if uniform:
        per_word = 1 + next(iter(slashes))
        values = _parse_number_rows(path, text.replace(b"/", b" ").translate(None, b"f"), lines, "f")
        if (
            words_per_line >= 3
            and values.shape[1] == words_per_line * per_word
            and not _is_ragged(text, words_per_line + 1)
        ):
            indices = values.astype(np.int64).reshape(lines, words_per_line, per_word)
            _add_fans(indices[:, :, :3], before, parts)
            return
    for number, line in enumerate(text.split(b"\n")[:lines]):
        words = [word.split(b"/") for word in line.split()[1:]]
        if len(words) < 3:
            continue
        try:
            width = min(max(map(len, words)), 3)
            indices = np.array([[int(part or 0) for part in [*word, b"", b""][:width]] for word in words])
        except ValueError as error:
            raise SceneFileError(f"{path}: a line 'f' holds something that is no number.") from error
        _add_fans(indices[None], before[number : number + 1], parts)


def _is_ragged(text: bytes, words_per_line: int) -> bool:
    """Return whether the lines have different word counts although the total fits."""
    data = np.frombuffer(text, np.uint8)
    gap = data <= SPACE
    starts = ~gap
    starts[1:] &= gap[:-1]  # first bytes of words
    ends = np.flatnonzero(data == NEWLINE)
    counts = np.diff(np.concatenate([[0], np.cumsum(starts, dtype=np.int64)[ends]]))
    return bool((counts != words_per_line).any())


def _add_fans(indices: Int64[np.ndarray, "f c w"], before: Int64[np.ndarray, "f 3"], parts: ObjParts) -> None:
    """Add polygons of ``c`` corners, each with one to three indices: vertex, texture coordinates, normal."""
    sides, width = indices.shape[1:]
    fan = fan_places(sides)
    # Numbers count from 1; negative ones count back from the newest before the line; 0 is none.
    places = np.where(indices > 0, indices - 1, indices + np.where(indices < 0, before[:, None, :width], -1))
    columns = [_to_int32(places[:, fan, column].reshape(-1, 3)) for column in range(width)]
    none = np.full(columns[0].shape, -1, np.int32)
    parts.triangles.append(columns[0])
    parts.triangle_uv.append(columns[1] if width > 1 else none)
    if parts.with_materials:
        if sides > 3:
            first = parts.triangle_count + len(fan) * np.arange(len(indices))
            parts.polygons.setdefault(sides, []).append(first)
        parts.triangle_normals.append(columns[2] if width > 2 else none)
    parts.triangle_count += len(none)


def _to_int32(numbers: Int64[np.ndarray, "t 3"]) -> Int32[np.ndarray, "t 3"]:
    """Convert to int32 with saturation, so that indices out of range stay out of range."""
    return np.clip(numbers, -1, np.iinfo(np.int32).max).astype(np.int32)


def cut_concave_polygons(parts: ObjParts, positions: Float64[np.ndarray, "v 3"]) -> None:
    """Cut polygons that are not convex, which are fans, into triangles that lie within them."""
    columns = [parts.triangles, parts.triangle_uv, parts.triangle_normals]
    if not parts.polygons:
        return
    rows = [np.concatenate(column) for column in columns]
    for sides, starts in parts.polygons.items():
        triangles = np.concatenate(starts)[:, None] + np.arange(sides - 2)
        fans = rows[0][triangles]
        if not (fans.min() >= 0 and fans.max() < len(positions)):
            continue  # refused by whoever reads the mesh
        fan = fan_places(sides)
        places = triangle_places(positions[_corners_of_fans(fans)])
        chosen = np.flatnonzero((places != fan).any(axis=(1, 2)))
        for row in rows:
            corners = _corners_of_fans(row[triangles[chosen]])
            cut = np.take_along_axis(corners, places[chosen].reshape(-1, places[0].size), axis=1)
            row[triangles[chosen]] = cut.reshape(-1, *fan.shape)
    for column, row in zip(columns, rows, strict=True):
        column[:] = [row]


def _corners_of_fans(fans: Int32[np.ndarray, "p t 3"]) -> Int32[np.ndarray, "p c"]:
    """Return the corners of polygons in their order."""
    return np.concatenate([fans[:, 0, :2], fans[:, :, 2]], axis=1)


def uv_of_vertices(path: Path, parts: ObjParts, count: int) -> Float32[np.ndarray, "v 2"] | None:
    """Return texture coordinates of ``count`` vertices, not-a-number where a vertex has none; or None."""
    if not parts.uv or not parts.triangle_uv:
        return None
    table = np.concatenate(parts.uv)
    uv = np.full((count, 2), np.nan, np.float32)
    for triangles, places in zip(parts.triangles, parts.triangle_uv, strict=True):
        if places.max(initial=-1) >= len(table):
            raise SceneFileError(f"{path}: a face names a texture coordinate that is not there.")
        vertices, places = triangles[places >= 0], places[places >= 0]
        if len(vertices) and not (vertices.min() >= 0 and vertices.max() < count):
            raise SceneFileError(f"{path}: a face names a vertex that is not there; the file is damaged.")
        uv[vertices] = table[places]
    return uv


def corner_values(
    path: Path, values: Sequence[np.ndarray], places: Sequence[np.ndarray], name: str
) -> Float32[np.ndarray, "t 3 w"] | None:
    """Return what all corners of triangles have, not-a-number where one has none; None where none has any.

    Args:
        path: named in errors.
        values: rows of the file.
        places: rows of the corners in these, -1 for none.
        name: what a row is called.

    Raises:
        SceneFileError: a corner names a row that is not there.
    """
    rows = np.concatenate([*places, np.zeros((0, 3), np.int32)])
    if not values or not (rows >= 0).any():
        return None
    table = np.concatenate([*values, np.full((1, values[0].shape[1]), np.nan, np.float32)])
    if rows.max() >= len(table) - 1:
        raise SceneFileError(f"{path}: a face names a {name} that is not there.")
    return np.asarray(table[rows])  # -1 is the last row
