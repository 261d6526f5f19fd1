"""SPZ (Niantic), about 15 bytes a Gaussian: versions 2, 3 and 4 in, 3, which every viewer reads, or 4 out."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Float64

from octasplat.engine.core.color import round_to_bytes
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.files.channel_columns import ChannelChoice
from octasplat.engine.files.encodings import (
    MAX_SH_DEGREE,
    SQRT_HALF,
    dropped_sh_message,
    from_smallest_three,
    half_turn_gaussians,
    half_turn_points,
    half_turn_quats,
    half_turn_sh,
    logits_from_bytes,
    smallest_three,
    turn_cloud,
)
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.range_losses import (
    find_harmonic_losses,
    find_position_losses,
    find_size_losses,
)
from octasplat.engine.files.registry import Exporter, Importer, register
from octasplat.engine.files.splat_rows import iterate_blocks, select_for_export
from octasplat.engine.files.spz_container import (
    ANTIALIASED,
    GZIP_MAGIC,
    MAGIC,
    SpzContent,
    SpzHeader,
    SpzSource,
    open_spz,
    write_spz,
)
from octasplat.engine.files.spz_records import (
    RIGHT_UP_BACK,
    right_up_back_from,
    unread_records_message,
)
from octasplat.engine.gaussians.flattening import (
    FLAT_LOG_SCALE,
    CloudBlocks,
    GaussianCloud,
    join_blocks,
    row_slices,
)
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import select_rows

COLOR_SCALE = 0.15
"""Constant harmonics h are written as the byte 255 (0.15 h + 0.5)."""
LOG_SCALE_STEPS = 16.0
LOG_SCALE_OFFSET = 10.0
FRACTIONAL_BITS = 12
"""The least precision of positions where they fit: 1/4096 of a unit."""
MAX_READ = 10_000_000
"""Gaussians that Niantic's reader takes, whatever the file says."""
SMALL_QUANTILE = 0.05
STEPS_PER_SIGMA = 8.0
"""Positions get as many more bits as it takes to place a small Gaussian this finely."""
SH_STEPS = (8, 16)
"""Steps of the coefficients of degree 1 and of the others, in 1/128; coarser steps compress better."""


def read(path: Path) -> GaussianCloud:
    """Read all Gaussians and turn them from y up to y down.

    Raises:
        SceneFileError: the file is no SPZ, is damaged, or of an unknown version.
    """
    return join_blocks(_read_blocks(path), path)


def _read_blocks(path: Path, _channels: ChannelChoice = "own") -> CloudBlocks:
    found = decode(open_spz(path))
    return CloudBlocks(found.count, ((rows, half_turn_gaussians(cloud)) for rows, cloud in found.blocks))


def decode(source: SpzSource) -> CloudBlocks:
    """Return all Gaussians as they stand in a file: y up.

    Raises:
        SceneFileError: there are none.
    """
    if source.count == 0:
        raise SceneFileError(f"{source.path}: holds no Gaussians.")
    return CloudBlocks(source.count, _decoded_blocks(source))


def _decoded_blocks(source: SpzSource) -> Iterator[tuple[slice, GaussianCloud]]:
    """Yield the Gaussians of the finest level, y up."""
    header, start = source.header, 0
    for rows, streams in source.blocks(row_slices(header.count)):
        cloud = _decode_block(header, streams)
        if source.is_finest is not None:
            cloud = select_rows(cloud, source.is_finest[rows])
            note = f"It has levels of detail; the finest was read, {source.count:,} of {header.count:,}."
            cloud = replace(cloud, notes=(*cloud.notes, note))
        if header.frame != RIGHT_UP_BACK:
            cloud = turn_cloud(cloud, right_up_back_from(header.frame))
        if count := len(cloud.means_world):
            yield slice(start, start + count), cloud
        start += count


def _decode_block(file: SpzHeader, streams: tuple[bytes, ...]) -> GaussianCloud:
    count = len(streams[1])  # a byte of opacity for each
    positions, opacities, colors, scales, rotations, harmonics = (
        np.frombuffer(stream, np.uint8).reshape(count, -1) for stream in streams
    )
    retained = (min(file.sh_degree, MAX_SH_DEGREE) + 1) ** 2
    rest = (harmonics.reshape(count, -1, 3)[:, : retained - 1].astype(np.float32) - 128.0) / 128.0
    constant = (colors.astype(np.float32) / 255.0 - 0.5) / COLOR_SCALE
    sh = np.concatenate([constant[:, None, :], rest], axis=1).astype(np.float32)
    quats = _decode_xyz(rotations) if file.version == 2 else _decode_smallest_three(rotations)
    if file.has_levels:
        opacities = np.minimum(opacities.astype(np.uint16) * 2, 255).astype(np.uint8)
    notes = [*dropped_sh_message(file.sh_degree), *unread_records_message(file.record_kinds)]
    if file.flags & ANTIALIASED:
        notes.append("The scene was trained with antialiasing, which is not modelled here.")
    return GaussianCloud(
        means_world=_fixed_point(positions, file.fractional_bits),
        quats_wxyz=quats,
        log_scales=scales.astype(np.float32) / LOG_SCALE_STEPS - LOG_SCALE_OFFSET,
        min_log_scale=-LOG_SCALE_OFFSET,
        opacity_logits=logits_from_bytes(opacities[:, 0]),
        sh=sh,
        notes=tuple(notes),
    )


def _fixed_point(packed: np.ndarray, fractional_bits: int) -> Float32[np.ndarray, "n 3"]:
    """Decode coordinates of three little-endian bytes, two's complement."""
    parts = packed.reshape(len(packed), 3, 3).astype(np.int32)
    values = parts[:, :, 0] | (parts[:, :, 1] << 8) | (parts[:, :, 2] << 16)
    signed = np.where(values >= 1 << 23, values - (1 << 24), values)
    return (signed / float(1 << fractional_bits)).astype(np.float32)


def _decode_xyz(packed: np.ndarray) -> Float32[np.ndarray, "n 4"]:
    """Decode quaternions of version 2: x, y, z as bytes; w completes the unit length."""
    xyz = packed.astype(np.float64) / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - np.sum(xyz**2, axis=1)))
    return np.concatenate([w[:, None], xyz], axis=1).astype(np.float32)


def _decode_smallest_three(packed: np.ndarray) -> Float32[np.ndarray, "n 4"]:
    """Decode quaternions: two bits for the largest component, ten for each other, sign first."""
    words = np.ascontiguousarray(packed).view("<u4")[:, 0]
    fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1).astype(np.int64)
    small = (fields & 511) * (SQRT_HALF / 511.0) * np.where(fields & 512, -1.0, 1.0)
    xyzw = from_smallest_three(small, (words >> 30).astype(np.int64))
    return np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]])


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians in their order, turned to y up.

    Raises:
        SceneFileError: nothing to write, values that are not finite, or positions beyond what 24 bits hold.
        OSError: the file cannot be written.
    """
    scene = select_for_export(gaussians, path, options)
    content = encode(scene, path, options.spz_version)
    with atomic_replace(path) as temporary, temporary.open("wb") as handle:
        write_spz(content, handle, path.parent)
    return (path,)


def encode(scene: FlatGaussians, path: Path, version: int) -> SpzContent:
    """Return the Gaussians in their order, turned to y up, as an SPZ of version 3 or 4.

    Each attribute is made when it is asked for, some thousands of Gaussians at a time.

    Raises:
        SceneFileError: positions are beyond what 24 bits hold; it names ``path``.
    """
    if _fitting_bits(scene) < 0:
        farthest = _farthest(scene)
        raise SceneFileError(
            f"{path}: not written; SPZ holds positions up to {2**23 - 1} units, one lies at {farthest:.3g}."
        )
    bits = _fractional_bits(scene)
    header = SpzHeader(version, len(scene), scene.sh_degree, bits, flags=0)
    packers = (
        lambda block: _pack_positions(half_turn_points(block.means_world).astype(np.float64) * (1 << bits)),
        lambda block: round_to_bytes(block.opacities.astype(np.float64) * 255.0).tobytes(),
        _pack_colors,
        _pack_scales,
        lambda block: _pack_rotations(half_turn_quats(block.quats_wxyz)),
        lambda block: _pack_sh(half_turn_sh(block.sh)),
    )
    return SpzContent(header, [map(pack, iterate_blocks(scene)) for pack in packers])


def _pack_colors(scene: FlatGaussians) -> bytes:
    return round_to_bytes((scene.sh[:, 0].astype(np.float64) * COLOR_SCALE + 0.5) * 255.0).tobytes()


def _pack_scales(scene: FlatGaussians) -> bytes:
    log_scales = np.concatenate([np.full((len(scene), 1), FLAT_LOG_SCALE), scene.log_scales], axis=1)
    return round_to_bytes((log_scales.astype(np.float64) + LOG_SCALE_OFFSET) * LOG_SCALE_STEPS).tobytes()


def _fitting_bits(scene: FlatGaussians) -> int:
    """Return how many fractional bits the farthest position leaves; negative where it has no room."""
    return int(np.floor(-np.log2(least_step(_farthest(scene)))))


def least_step(farthest: Float64[np.ndarray, "..."] | float) -> Float64[np.ndarray, "..."]:
    """Return the step of positions that largest absolute coordinates leave, a power of two."""
    # 2^bits |x| <= 2^23 - 1
    return np.asarray(2.0 ** -np.floor(np.log2((2**23 - 1) / np.maximum(farthest, 1.0 / 256.0))))


def _farthest(scene: FlatGaussians) -> float:
    """Return the largest absolute coordinate."""
    return float(max(-scene.means_world.min(), scene.means_world.max()))


def _fractional_bits(scene: FlatGaussians) -> int:
    small = _quantile_in_place(np.minimum(scene.log_scales[:, 0], scene.log_scales[:, 1]), SMALL_QUANTILE)
    needed = int(np.ceil(np.log2(STEPS_PER_SIGMA) - small / np.log(2.0)))  # 2^bits sigma >= STEPS_PER_SIGMA
    return min(max(needed, FRACTIONAL_BITS), _fitting_bits(scene), 23)


def _quantile_in_place(values: Float32[np.ndarray, " n"], share: float) -> float:
    """Return what ``np.quantile`` does of the same numbers in 64 bits, which would take thrice the memory."""
    place = share * (len(values) - 1)
    below = int(place)
    values.partition([below, min(below + 1, len(values) - 1)])
    low, high = float(values[below]), float(values[min(below + 1, len(values) - 1)])
    part = place - below
    return low + (high - low) * part if part < 0.5 else high - (high - low) * (1 - part)


def _find_losses(scene: FlatGaussians) -> tuple[str, ...]:
    if len(scene) == 0 or not scene.is_finite() or _fitting_bits(scene) < 0:
        return ()  # which is refused
    sizes, harmonics = find_range_losses("spz", scene)
    step = 2.0 ** -_fractional_bits(scene)
    count: tuple[str, ...] = ()
    if len(scene) > MAX_READ:
        count = (
            f"Niantic's reader, which many viewers use, takes no SPZ of more than {MAX_READ:,} Gaussians; "
            f"this one has {len(scene):,} (octasplat simplify, or several files by octasplat crop).",
        )
    return (*count, *sizes, *find_position_losses("spz", scene, lambda _rows: step), *harmonics)


def find_range_losses(format_name: str, scene: FlatGaussians) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return what bytes lose of the sizes and of the harmonics of a finite scene, in sentences.

    Args:
        format_name: of the format that has an SPZ in it.
        scene: what is written, not empty.
    """
    half = 0.5 / LOG_SCALE_STEPS  # what is this far out of range is still rounded to its end
    largest = 255.0 / LOG_SCALE_STEPS - LOG_SCALE_OFFSET
    return (
        find_size_losses(format_name, scene, -LOG_SCALE_OFFSET - half, largest + half),
        find_harmonic_losses(format_name, scene, 1.0),
    )


def _pack_positions(steps: Float[np.ndarray, "n 3"]) -> bytes:
    integers = np.ascontiguousarray(np.rint(steps).astype("<i4"))
    return integers.view(np.uint8).reshape(*steps.shape, 4)[:, :, :3].tobytes()  # the three low bytes


def _pack_rotations(quats_wxyz: Float32[np.ndarray, "n 4"]) -> bytes:
    small, largest = smallest_three(quats_wxyz[:, [1, 2, 3, 0]])
    sizes = np.minimum(np.rint(np.abs(small) / SQRT_HALF * 511.0), 511.0).astype(np.uint32)
    fields = sizes | (np.uint32(512) * (small < 0).astype(np.uint32))
    words = (largest.astype(np.uint32) << 30) | (fields[:, 0] << 20) | (fields[:, 1] << 10) | fields[:, 2]
    return words.astype("<u4").tobytes()


def _pack_sh(sh: Float32[np.ndarray, "n k 3"]) -> bytes:
    if sh.shape[1] == 1:
        return b""
    steps = np.full((sh.shape[1] - 1, 1), SH_STEPS[1], dtype=np.float64)
    steps[:3] = SH_STEPS[0]
    bins = np.rint(sh[:, 1:].astype(np.float64) * 128.0 / steps)
    return round_to_bytes(bins * steps + 128.0).tobytes()


def _recognises(head: bytes) -> bool:
    return head.startswith((MAGIC, GZIP_MAGIC))


register(
    Importer(
        "spz", ("*.spz",), "SPZ of Niantic, versions 2 to 4", read, _recognises, read_blocks=_read_blocks
    )
)
register(
    Exporter(
        "spz",
        ("*.spz",),
        "SPZ of Niantic, 15 bytes a Gaussian, for web viewers",
        write,
        holds_harmonics=True,
        find_losses=_find_losses,
    )
)
