"""Flattening of three-dimensional Gaussians of other programs, and its losses."""

import contextlib
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Int

from octasplat.engine.core.errors import DiskFullError, SceneFileError
from octasplat.engine.gaussians.channels import Channels, check_row_count
from octasplat.engine.gaussians.model import FLAT_SCALE, FlatGaussians
from octasplat.engine.gaussians.rows import (
    RowIndex,
    allocate_rows,
    overwrite_rows,
    row_arrays,
    select_into_files,
    select_rows,
    view_rows,
)

FLAT_LOG_SCALE = np.float32(np.log(FLAT_SCALE))
LOG_SCALE_TOLERANCE = np.float32(1e-5)
"""The flat ln scale may be off by this in formats that hold the scale itself."""
MAX_LOGIT = np.float32(16.0)
"""Stands for an infinite logit, which converters write for opacity 1; its sigmoid is 1 - 1e-7."""
MAX_THICKNESS_RATIO = 0.5
"""Gaussians whose thickness is more than this share of their next extent are no surfaces."""
ROWS_PER_BLOCK = 16384
"""Gaussians that are dealt with at a time, some megabytes of them."""
_CYCLIC_ROTATIONS = np.array([[1, 0, 0, 0], [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5]], dtype=np.float32)
"""Quaternions of P_k, whose columns are the axes k, k+1, k+2 (mod 3): they turn axis k into the first."""


MANY_BYTES = 256 << 20
"""Of a scene that is rather in files than in memory, a million Gaussians with harmonics of degree 3."""


@dataclass(frozen=True)
class GaussianCloud:
    """Gaussians as stored in a file, flat or not; values may be anything, even not finite.

    Attributes:
        means_world: centres, world units.
        quats_wxyz: rotations, not necessarily of unit length.
        log_scales: ln of the standard deviations along all three axes, or along the two in the plane.
        opacity_logits: opacity is their sigmoid; infinite where it is 0 or 1.
        sh: coefficients of the display color, coefficient-major, as in
            :class:`octasplat.engine.gaussians.model.FlatGaussians`.
        notes: what the reader of the file left out or had to assume, one sentence each.
        channels: what else is known of each, by name.
        min_log_scale: the smallest ln scale that the format can hold; what is no thicker counts as flat.
        normal_axis: the axis that is the normal, whatever the scales, where the format says so. None: the
            smallest of three scales, or axis 0 where there are two.
    """

    means_world: Float32[np.ndarray, "n 3"]
    quats_wxyz: Float32[np.ndarray, "n 4"]
    log_scales: Float32[np.ndarray, "n s"]
    opacity_logits: Float32[np.ndarray, " n"]
    sh: Float32[np.ndarray, "n k 3"]
    notes: tuple[str, ...] = ()
    channels: Channels = field(default_factory=Channels)
    min_log_scale: float = float(FLAT_LOG_SCALE)
    normal_axis: Literal[0, 2] | None = None

    def __post_init__(self) -> None:
        """Check that channels have as many rows as there are Gaussians."""
        check_row_count(self.channels, len(self.means_world))


@dataclass(frozen=True)
class CloudBlocks:
    """The Gaussians of a file, some thousands at a time, so that a file need not be in memory.

    Attributes:
        count: of all together.
        blocks: Gaussians and their rows among all; may be gone through once.
    """

    count: int
    blocks: Iterable[tuple[RowIndex, GaussianCloud]]


@dataclass(frozen=True)
class ImportReport:
    """Counts of what reading a file of Gaussians found and dropped.

    Attributes:
        count: number of Gaussians read.
        sh_degree: degree of their spherical harmonics.
        scale_count: scales per Gaussian in the file, 2 or 3.
        flattened: Gaussians thicker than the flat scale, whose smallest extent was dropped.
        median_thickness: over the flattened ones, median of smallest / second-smallest scale (1 = a ball or a
            needle, no surface at all; 0 if none was flattened).
        max_thickness: the largest such ratio.
        saturated: opacities of exactly 0 or 1, whose infinite logits became -16 or 16.
        thick: Gaussians whose ratio is more than ``MAX_THICKNESS_RATIO``, which a flat one cannot stand for.
        dropped: Gaussians left out because a value was not finite or a rotation had no length.
        notes: what else the reader left out or assumed, one sentence each.
        kept: which rows of the file were read; None for all.
    """

    count: int
    sh_degree: int
    scale_count: int
    flattened: int
    median_thickness: float
    max_thickness: float
    saturated: int
    thick: int = 0
    dropped: int = 0
    notes: tuple[str, ...] = ()
    kept: Bool[np.ndarray, " m"] | None = field(default=None, repr=False, compare=False)


def row_slices(count: int, rows_per_block: int = ROWS_PER_BLOCK) -> Iterator[slice]:
    """Yield the rows of all blocks, in order."""
    for start in range(0, count, rows_per_block):
        yield slice(start, min(start + rows_per_block, count))


def split_cloud(cloud: GaussianCloud) -> CloudBlocks:
    """Return a cloud that is in memory some thousand Gaussians at a time, not copied."""
    count = len(cloud.means_world)
    return CloudBlocks(count, ((rows, view_rows(cloud, rows)) for rows in row_slices(count)))


def join_blocks(source: CloudBlocks, path: Path) -> GaussianCloud:
    """Return all Gaussians of a file as it has them.

    Raises:
        SceneFileError: there are none; it names ``path``.
    """
    joined: GaussianCloud | None = None
    notes: dict[str, None] = {}  # each once, in order
    for rows, cloud in source.blocks:
        if joined is None:
            joined = allocate_rows(cloud, source.count)
        overwrite_rows(joined, rows, cloud)
        notes.update(dict.fromkeys(cloud.notes))
    if joined is None:
        raise SceneFileError(f"{path}: holds no Gaussians.")
    return replace(joined, notes=tuple(notes))


def flatten(
    source: GaussianCloud | CloudBlocks,
    path: Path,
    *,
    drop_invalid: bool = False,
    folder: Path | None = None,
) -> tuple[FlatGaussians, ImportReport]:
    """Flatten each Gaussian along its smallest axis, or along ``normal_axis``, some thousands at a time.

    The axes are relabelled, which changes neither the directions of the other two nor their scales. Gaussians
    that have our own flat scale on axis 0 come out bit for bit.

    Args:
        source: what a file holds.
        path: names the file in errors.
        drop_invalid: leave out Gaussians with values that are not finite, instead of refusing the file.
        folder: for files without a name that hold the Gaussians where these are many, :data:`MANY_BYTES`;
            None for memory.

    Raises:
        SceneFileError: there are no Gaussians, or some hold values that are not finite or rotations of length
            zero.
    """
    if isinstance(source, GaussianCloud):
        source = split_cloud(source)
    if source.count == 0:
        raise SceneFileError(f"{path}: holds no Gaussians.")
    scene: FlatGaussians | None = None
    kept = np.zeros(source.count, bool)
    invalid: Counter[str] = Counter()
    notes: dict[str, None] = {}  # each once, in order
    thickness: list[np.ndarray] = []
    saturated, scale_count = 0, 2
    for rows, cloud in source.blocks:
        valid, found = _valid_mask(cloud)
        invalid.update(found)
        notes.update(dict.fromkeys(cloud.notes))
        scale_count = cloud.log_scales.shape[1]
        if found:
            if not drop_invalid:
                continue  # the rest is only looked at, for how many there are
            numbers = np.arange(*rows.indices(source.count)) if isinstance(rows, slice) else rows
            rows = numbers[valid]
            cloud = select_rows(cloud, valid)
        block, ratios = _flatten_block(cloud)
        if scene is None:
            scene = _allocate_scene(block, source.count, folder)
        scene.put(rows, block)
        kept[rows] = True
        thickness.append(ratios)
        saturated += int(np.isinf(cloud.opacity_logits).sum())
    if invalid and not drop_invalid:
        raise _invalid_error(path, invalid, source.count)
    if scene is None or not kept.any():
        raise SceneFileError(f"{path}: none of its {source.count} Gaussians has finite values only.")
    gaussians = scene if kept.all() else select_gaussians(scene, kept, folder)
    ratios = np.concatenate(thickness)
    report = ImportReport(
        count=len(gaussians),
        sh_degree=gaussians.sh_degree,
        scale_count=scale_count,
        flattened=len(ratios),
        median_thickness=float(np.median(ratios)) if len(ratios) else 0.0,
        max_thickness=float(ratios.max()) if len(ratios) else 0.0,
        saturated=saturated,
        thick=int((ratios > MAX_THICKNESS_RATIO).sum()),
        dropped=source.count - len(gaussians),
        notes=tuple(notes),
        kept=None if kept.all() else kept,
    )
    return gaussians, report


def _flatten_block(cloud: GaussianCloud) -> tuple[FlatGaussians, Float32[np.ndarray, " m"]]:
    """Return valid Gaussians flattened, and the thickness ratio of those that were not flat already."""
    infinite = np.isinf(cloud.opacity_logits)
    logits = np.where(infinite, np.copysign(MAX_LOGIT, cloud.opacity_logits), cloud.opacity_logits)
    scale_count = cloud.log_scales.shape[1]
    if scale_count == 3 and cloud.normal_axis is None:
        quats, in_plane, thickness = _flatten_smallest_axis(
            cloud.quats_wxyz, cloud.log_scales, np.float32(max(cloud.min_log_scale, float(FLAT_LOG_SCALE)))
        )
    else:
        normal = cloud.normal_axis or 0
        quats = rotate_axis_to_first(cloud.quats_wxyz, np.full(len(cloud.means_world), normal))
        in_plane, thickness = cloud.log_scales, np.empty(0, np.float32)
        if scale_count == 3:
            in_plane = np.ascontiguousarray(in_plane[:, [(normal + 1) % 3, (normal + 2) % 3]])
    gaussians = FlatGaussians(
        means_world=cloud.means_world,
        quats_wxyz=quats,
        log_scales=in_plane,
        opacity_logits=logits.astype(np.float32),
        sh=cloud.sh,
        channels=cloud.channels,
    )
    return gaussians, thickness


_NO_LENGTH = "a rotation of length zero"


def _allocate_scene(block: FlatGaussians, count: int, folder: Path | None) -> FlatGaussians:
    """Return a scene of so many Gaussians like those of a block, not filled yet.

    Files spare memory and are no more than that: where there is no room for them, the scene is in memory.
    """
    if _are_many(block, count):
        with contextlib.suppress(DiskFullError):
            return allocate_rows(block, count, folder)
    return allocate_rows(block, count)


def select_gaussians(
    scene: FlatGaussians, mask: Bool[np.ndarray, " n"], folder: Path | None
) -> FlatGaussians:
    """Return a copy of the Gaussians in a mask.

    Args:
        scene: the scene.
        mask: which of its Gaussians.
        folder: for files without a name that hold them where these are many, as in :func:`flatten`.
    """
    if folder is not None and _are_many(scene, int(mask.sum())):
        with contextlib.suppress(DiskFullError):
            return select_into_files(scene, mask, folder)
    return scene.select(mask)


def _are_many(block: FlatGaussians, count: int) -> bool:
    """Return whether so many Gaussians like those of a block are rather in files than in memory."""
    return sum(array[:1].nbytes for array in row_arrays(block).values()) * count >= MANY_BYTES


def _valid_mask(cloud: GaussianCloud) -> tuple[Bool[np.ndarray, " n"], dict[str, int]]:
    """Return which Gaussians are valid, and how many are not for each reason that there is."""
    scales = cloud.log_scales
    ordered = np.sort(scales, axis=1)  # not-a-number comes last
    # A normal may be infinitely thin; nothing else may be infinite.
    bad_scale = ~np.isfinite(ordered[:, -2:]).all(axis=1) | np.isnan(scales).any(axis=1)
    bad = {
        "no finite position": ~np.isfinite(cloud.means_world).all(axis=1),
        "no finite rotation": ~np.isfinite(cloud.quats_wxyz).all(axis=1),
        "no finite scale": bad_scale,
        # An infinite one stands for an opacity of 0 or 1.
        "no finite opacity": np.isnan(cloud.opacity_logits),
        "no finite color": ~np.isfinite(cloud.sh).all(axis=(1, 2)),
        **{f"no finite {name}": ~np.isfinite(a).all(axis=1) for name, a in cloud.channels.items()},
        _NO_LENGTH: (cloud.quats_wxyz == 0).all(axis=1),
    }
    valid: Bool[np.ndarray, " n"] = ~np.logical_or.reduce(list(bad.values()))
    return valid, {reason: int(mask.sum()) for reason, mask in bad.items() if mask.any()}


def _invalid_error(path: Path, invalid: Counter[str], count: int) -> SceneFileError:
    """Return the error for the first reason in the order of the parameters, rotations without length last."""
    order = ("position", "rotation", "scale", "opacity", "color")
    first = [reason for name in order if (reason := f"no finite {name}") in invalid]
    reason = [*first, *(reason for reason in invalid if reason != _NO_LENGTH), _NO_LENGTH][0]
    advice = "octasplat import --drop-invalid leaves them out"
    return SceneFileError(f"{path}: {invalid[reason]} of {count} Gaussians have {reason}; {advice}.")


def _flatten_smallest_axis(
    quats_wxyz: Float32[np.ndarray, "n 4"], log_scales: Float32[np.ndarray, "n 3"], flat_log_scale: np.float32
) -> tuple[Float32[np.ndarray, "n 4"], Float32[np.ndarray, "n 2"], Float32[np.ndarray, " m"]]:
    """Make the smallest axis the normal; also return the thickness ratio of those not flat already.

    Axis 0 wins ties, and always where it holds the flat scale, so that our own files stay as they are.
    """
    own = np.abs(log_scales[:, 0] - flat_log_scale) <= LOG_SCALE_TOLERANCE
    axis = np.where(own, 0, np.argmin(log_scales, axis=1))
    # In cyclic order, so that frames stay right-handed
    order = (axis[:, None] + np.arange(3)) % 3
    ordered = np.take_along_axis(log_scales, order, axis=1)
    in_plane = np.ascontiguousarray(ordered[:, 1:])
    thick: Bool[np.ndarray, " n"] = ordered[:, 0] > flat_log_scale + LOG_SCALE_TOLERANCE
    ratios = np.exp(ordered[thick, 0] - in_plane[thick].min(axis=1))
    return rotate_axis_to_first(quats_wxyz, axis), in_plane, ratios


def rotate_axis_to_first(
    quats_wxyz: Float32[np.ndarray, "n 4"], axis: Int[np.ndarray, " n"]
) -> Float32[np.ndarray, "n 4"]:
    """Return quaternions of R P_axis, whose first column is column ``axis`` of R, the others cyclically.

    Those of axis 0 keep every bit, and no length changes.
    """
    w, x, y, z = quats_wxyz.T
    a, b, c, d = _CYCLIC_ROTATIONS[axis].T
    # Hamilton product
    product = np.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        axis=-1,
    )
    return np.where((axis == 0)[:, None], quats_wxyz, product)
