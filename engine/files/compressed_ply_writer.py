"""Compressed PLY written: Gaussians in spatially compact chunks of 256, so that their bounds are tight."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, UInt32

from octasplat.engine.core.ply_container import PlyWriteElement, write_ply
from octasplat.engine.files.compressed_ply import CHUNK_SIZE, PATTERNS, SH_RANGE
from octasplat.engine.files.encodings import SQRT_HALF, smallest_three
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.kd_split import kd_order
from octasplat.engine.files.place_comments import place_comments
from octasplat.engine.files.range_losses import (
    find_harmonic_losses,
    find_position_losses,
    find_thickness_losses,
)
from octasplat.engine.files.registry import Exporter, register
from octasplat.engine.files.splat_rows import select_for_export
from octasplat.engine.gaussians.flattening import row_slices
from octasplat.engine.gaussians.model import FLAT_SCALE, SH_C0, FlatGaussians


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians in compact chunks; the flat axis is the first, with a deviation of 1e-5.

    Raises:
        SceneFileError: nothing to write, values that are not finite, or the file cannot be written.
    """
    scene = select_for_export(gaussians, path, options)
    order = kd_order(scene.means_world, CHUNK_SIZE)
    count = len(scene)
    chunks = np.empty(-(-count // CHUNK_SIZE), dtype=[(name, "<f4") for name in _bound_names()])
    for rows in row_slices(count):
        own = chunks[rows.start // CHUNK_SIZE : -(-rows.stop // CHUNK_SIZE)]
        for key, values in _groups(scene.select(order[rows])).items():
            low, high = _chunk_bounds(values)
            for axis, (least, most) in enumerate(_bound_columns(key)):
                own[least], own[most] = low[:, axis], high[:, axis]
    vertex = np.dtype([(f"packed_{what}", "<u4") for what in _PACKED_WORDS])
    elements = [
        PlyWriteElement("chunk", len(chunks), chunks.dtype, [chunks]),
        PlyWriteElement("vertex", count, vertex, _vertex_blocks(scene, order, chunks, vertex)),
    ]
    if scene.sh_degree > 0:
        dtype = np.dtype([(f"f_rest_{k}", "u1") for k in range(3 * (scene.sh.shape[1] - 1))])
        blocks = (_pack_harmonics(scene.sh[order[rows], 1:], dtype) for rows in row_slices(count))
        elements.append(PlyWriteElement("sh", count, dtype, blocks))
    write_ply(path, elements, place_comments(options.facts.origin_world, options.facts.georeference))
    return (path,)


def _groups(scene: FlatGaussians) -> dict[str, Float64[np.ndarray, "n 3"]]:
    """Return what is packed within the bounds of a chunk, by the beginning of their names."""
    flat = np.full((len(scene), 1), np.log(FLAT_SCALE))
    return {
        "": scene.means_world.astype(np.float64),
        "scale_": np.concatenate([flat, scene.log_scales], axis=1, dtype=np.float64),
        "rgb": 0.5 + SH_C0 * scene.sh[:, 0].astype(np.float64),
    }


def _vertex_blocks(
    scene: FlatGaussians, order: Int[np.ndarray, " n"], chunks: np.ndarray, vertex: np.dtype[np.void]
) -> Iterator[np.ndarray]:
    for rows in row_slices(len(scene)):  # a block begins with a chunk
        part = scene.select(order[rows])
        place = np.arange(rows.start, rows.stop) // CHUNK_SIZE
        shares = {}
        for key, values in _groups(part).items():
            columns = _bound_columns(key)
            low = np.stack([chunks[least] for least, _ in columns], axis=1)[place]
            high = np.stack([chunks[most] for _, most in columns], axis=1)[place]
            # Against the bounds as the file has them, in 32 bits, as they are decoded with these
            extent = (high - low).astype(np.float64)
            offset = values - low.astype(np.float64)
            shares[key] = np.divide(offset, extent, out=np.zeros_like(values), where=extent > 0)
        vertices = np.empty(len(part), dtype=vertex)
        vertices["packed_position"] = _pack_word(shares[""], (11, 10, 11))
        vertices["packed_rotation"] = _pack_rotations(part)
        vertices["packed_scale"] = _pack_word(shares["scale_"], (11, 10, 11))
        opacities = part.opacities.astype(np.float64)[:, None]
        color = np.concatenate([shares["rgb"], opacities], axis=1)
        vertices["packed_color"] = _pack_word(color, (8, 8, 8, 8))
        yield vertices


def _pack_harmonics(rest: Float32[np.ndarray, "n k 3"], dtype: np.dtype[np.void]) -> np.ndarray:
    channel_major = rest.astype(np.float64).transpose(0, 2, 1).reshape(len(rest), -1)
    # Rounded down to the interval whose middle is decoded
    steps = np.clip(np.floor((channel_major / SH_RANGE + 0.5) * 256.0), 0, 255).astype(np.uint8)
    return np.asarray(steps.view(dtype)[:, 0])


def _find_losses(scene: FlatGaussians) -> tuple[str, ...]:
    if len(scene) == 0 or not scene.is_finite():
        return ()  # which is refused
    order = kd_order(scene.means_world, CHUNK_SIZE)
    steps = np.empty(len(scene))
    for rows in row_slices(len(scene)):
        own = order[rows]
        low, high = _chunk_bounds(scene.means_world[own].astype(np.float64))
        of_chunks = ((high - low) / [2047.0, 1023.0, 2047.0]).max(axis=1)
        steps[own] = of_chunks[np.arange(len(own)) // CHUNK_SIZE]
    del order
    return (
        *find_thickness_losses("compressed-ply", scene),
        *find_position_losses("compressed-ply", scene, lambda rows: steps[rows]),
        *find_harmonic_losses("compressed-ply", scene, SH_RANGE / 2),
    )


_PACKED_WORDS = ("position", "rotation", "scale", "color")


def _bound_names() -> list[str]:
    names = []
    for prefix, letters in (("", "xyz"), ("scale_", "xyz"), ("", "rgb")):
        names += [f"{end}_{prefix}{letter}" for end in ("min", "max") for letter in letters]
    return names


def _bound_columns(key: str) -> list[tuple[str, str]]:
    """Return the columns of the bounds of each axis of a group, the lower one first."""
    letters = "rgb" if key == "rgb" else [f"{key}{axis}" for axis in "xyz"]
    return [(f"min_{letter}", f"max_{letter}") for letter in letters]


def _chunk_bounds(
    values: Float64[np.ndarray, "n 3"],
) -> tuple[Float64[np.ndarray, "c 3"], Float64[np.ndarray, "c 3"]]:
    starts = np.arange(0, len(values), CHUNK_SIZE)
    return np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)


def _pack_word(shares: Float[np.ndarray, "n f"], bits: tuple[int, ...]) -> UInt32[np.ndarray, " n"]:
    word = np.zeros(len(shares), np.uint32)
    for place, size in enumerate(bits):
        steps = (1 << size) - 1
        field = np.rint(np.clip(shares[:, place], 0.0, 1.0) * steps).astype(np.uint32)
        word = (word << np.uint32(size)) | field
    return word


def _pack_rotations(scene: FlatGaussians) -> UInt32[np.ndarray, " n"]:
    small, largest = smallest_three(scene.quats_wxyz)
    packed = _pack_word(small / (2.0 * SQRT_HALF) + 0.5, (10, 10, 10))
    return np.asarray((largest.astype(np.uint32) << np.uint32(30)) | packed)


register(
    Exporter(
        "compressed-ply",
        PATTERNS,
        "compressed PLY of PlayCanvas and SuperSplat, 16 bytes a Gaussian",
        write,
        holds_harmonics=True,
        holds_origin=True,
        find_losses=_find_losses,
    )
)
