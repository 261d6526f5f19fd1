"""Compressed PLY of PlayCanvas and SuperSplat: 16 bytes a Gaussian, quantised within chunks of 256.

Element ``chunk`` holds the bounds of positions, ln scales and (in newer files) colors; element ``vertex``
has four uint32 a Gaussian; an optional element ``sh`` has a byte a higher coefficient, channel-major.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int, UInt32

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import PlyHeader, columns, read_ply, read_ply_header
from octasplat.engine.files.channel_columns import ChannelChoice
from octasplat.engine.files.encodings import SQRT_HALF, from_smallest_three, logits_from_bytes, sh0_from_rgb
from octasplat.engine.files.registry import Importer, register
from octasplat.engine.gaussians.flattening import CloudBlocks, GaussianCloud, join_blocks, row_slices

PATTERNS = ("*.compressed.ply",)
CHUNK_SIZE = 256
SH_RANGE = 8.0
"""Higher coefficients lie in [-4, 4]."""
_PACKED_PROPERTIES = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_REST_COUNTS = (9, 24, 45)


def read(path: Path) -> GaussianCloud:
    """Read and unpack all Gaussians.

    Raises:
        SceneFileError: the file is no compressed PLY, is truncated, or its chunks do not fit its Gaussians.
    """
    return join_blocks(_read_blocks(path), path)


def _read_blocks(path: Path, _channels: ChannelChoice = "own") -> CloudBlocks:
    header = read_ply_header(path)
    _check_elements(path, header)
    names = ["chunk", "vertex", *(["sh"] if header.element("sh") is not None else [])]
    _, tables = read_ply(path, names)
    count = len(tables["vertex"])

    def block(rows: slice) -> GaussianCloud:
        # A block begins with a chunk.
        chunks = slice(rows.start // CHUNK_SIZE, -(-rows.stop // CHUNK_SIZE))
        own = {name: table[chunks if name == "chunk" else rows] for name, table in tables.items()}
        return _decode(own)

    return CloudBlocks(count, ((rows, block(rows)) for rows in row_slices(count)))


def _decode(tables: Mapping[str, np.ndarray]) -> GaussianCloud:
    packed = {
        name: np.ascontiguousarray(tables["vertex"][name]).astype(np.uint32) for name in _PACKED_PROPERTIES
    }
    chunk = np.arange(len(tables["vertex"])) // CHUNK_SIZE
    rgba = packed["packed_color"]  # from the highest byte: red, green, blue, opacity
    color = np.stack([(rgba >> shift) & 255 for shift in (24, 16, 8)], axis=1).astype(np.float32) / 255
    if "min_r" in (tables["chunk"].dtype.names or ()):
        color = _dequantise(tables["chunk"], "{}_{}", "rgb", chunk, color)
    sh = sh0_from_rgb(color)
    if "sh" in tables:
        sh = np.concatenate([sh, _sh_rest(tables["sh"])], axis=1)
    return GaussianCloud(
        means_world=_dequantise(
            tables["chunk"], "{}_{}", "xyz", chunk, _unpack_11_10_11(packed["packed_position"])
        ),
        quats_wxyz=_unpack_rotations(packed["packed_rotation"]),
        log_scales=_dequantise(
            tables["chunk"], "{}_scale_{}", "xyz", chunk, _unpack_11_10_11(packed["packed_scale"])
        ),
        opacity_logits=logits_from_bytes((rgba & 255).astype(np.uint8)),
        sh=sh,
    )


def _check_elements(path: Path, header: PlyHeader) -> None:
    chunk, vertex, sh = (header.element(name) for name in ("chunk", "vertex", "sh"))
    if chunk is None or vertex is None:
        raise SceneFileError(f"{path}: is no compressed PLY; it needs the elements 'chunk' and 'vertex'.")
    bounds = [f"{end}_{what}" for end in ("min", "max") for what in ("x", "y", "z")]
    bounds += [f"{end}_scale_{what}" for end in ("min", "max") for what in ("x", "y", "z")]
    if "min_r" in chunk.names:
        bounds += [f"{end}_{what}" for end in ("min", "max") for what in ("r", "g", "b")]
    missing = [name for name in bounds if name not in chunk.names]
    missing += [name for name in _PACKED_PROPERTIES if name not in vertex.names]
    if missing:
        raise SceneFileError(f"{path}: is no compressed PLY; it lacks the property {', '.join(missing)}.")
    wrong = [prop.name for prop in vertex.properties if prop.name in _PACKED_PROPERTIES and prop.kind != "u4"]
    if wrong:
        raise SceneFileError(f"{path}: its property {wrong[0]} should be of type uint.")
    if chunk.count != -(-vertex.count // CHUNK_SIZE):
        raise SceneFileError(
            f"{path}: has {chunk.count} chunks for {vertex.count} Gaussians, which do not belong together."
        )
    if sh is not None:
        rest = [f"f_rest_{k}" for k in range(len(sh.names))]
        if len(rest) not in _REST_COUNTS or set(rest) != set(sh.names) or sh.count != vertex.count:
            raise SceneFileError(
                f"{path}: its element 'sh' should hold f_rest_0 to f_rest_8, 23 or 44 for each Gaussian."
            )


def _unpack_11_10_11(packed: UInt32[np.ndarray, " n"]) -> Float32[np.ndarray, "n 3"]:
    """Unpack 11, 10 and 11 bits to numbers in [0, 1]."""
    fields = [(packed >> 21) / 2047, ((packed >> 11) & 1023) / 1023, (packed & 2047) / 2047]
    return np.stack(fields, axis=1).astype(np.float32)


def _dequantise(
    chunks: np.ndarray, name: str, axes: str, chunk: Int[np.ndarray, " n"], share: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Scale numbers in [0, 1] to the bounds of their chunks."""
    low = columns(chunks, [name.format("min", axis) for axis in axes])[chunk]
    high = columns(chunks, [name.format("max", axis) for axis in axes])[chunk]
    return low * (1 - share) + high * share


def _unpack_rotations(packed: UInt32[np.ndarray, " n"]) -> Float32[np.ndarray, "n 4"]:
    """Unpack quaternions: two bits for the index of the largest component, 10 bits for each other one."""
    fields = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    # A component that is not the largest is at most sqrt(1/2) in size.
    small = (fields / 1023.0 - 0.5) * (2.0 * SQRT_HALF)
    return from_smallest_three(small, (packed >> 30).astype(np.int64))


def _sh_rest(table: np.ndarray) -> Float32[np.ndarray, "n k 3"]:
    count = len(table.dtype.names or ())
    steps = columns(table, [f"f_rest_{k}" for k in range(count)])
    # 0 and 255 stand for the bounds, every other step for the middle of its interval.
    share = np.where(steps == 0, 0.0, np.where(steps == 255, 1.0, (steps + 0.5) / 256.0))
    rest = ((share - 0.5) * SH_RANGE).astype(np.float32)
    return rest.reshape(len(table), 3, count // 3).transpose(0, 2, 1)


def _recognises(head: bytes) -> bool:
    return head.startswith(b"ply") and b"packed_position" in head


register(
    Importer(
        "compressed-ply",
        PATTERNS,
        "compressed PLY of PlayCanvas and SuperSplat",
        read,
        _recognises,
        read_blocks=_read_blocks,
    )
)
