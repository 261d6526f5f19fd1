"""The native file: flat Gaussians in the PLY layout of the 3DGS family.

One element ``vertex``, all float32: ``x y z``, ``nx ny nz`` (zeros), ``f_dc_0..2``, ``f_rest_*``
channel-major (all red, then green, then blue), ``opacity`` (logit), ``scale_0..2`` (ln of the standard
deviations) and ``rot_0..3`` (w, x, y, z). The flat axis, the normal r1, is axis 0 with scale ln 1e-5, so that
every viewer of 3DGS files shows the scene.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float32, Int

from engine.errors import SceneFileError
from engine.gaussians.model import FLAT_SCALE, FlatGaussians
from engine.gaussians.ply_format import (
    PlyElement,
    PlyWriteElement,
    columns,
    read_ply,
    read_ply_header,
    write_ply,
)

FLAT_LOG_SCALE = np.float32(np.log(FLAT_SCALE))
MAX_SH_DEGREE = 3
LARGEST_LOGIT = np.float32(16.0)
"""Stands for an infinite logit, which converters write for opacity 1; its sigmoid is 1 - 1e-7."""
ROWS_AT_ONCE = 65536
_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_SH_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_CYCLIC_TURNS = np.array([[1, 0, 0, 0], [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5]], dtype=np.float32)
"""Quaternions of P_k, whose columns are the axes k, k+1, k+2 (mod 3): they turn axis k into the first."""


@dataclass(frozen=True)
class ImportReport:
    """What reading a file of Gaussians found, and what it lost.

    Attributes:
        count: number of Gaussians.
        sh_degree: degree of their spherical harmonics.
        scale_count: scales per Gaussian in the file, 2 or 3.
        flattened: Gaussians thicker than the flat scale, whose smallest extent was dropped.
        median_thickness: over the flattened ones, median of smallest / second-smallest scale (1 = a ball or a
            needle, no surface at all; 0 if none was flattened).
        max_thickness: the largest such ratio.
        saturated: opacities of exactly 0 or 1, whose infinite logits became -16 or 16.
    """

    count: int
    sh_degree: int
    scale_count: int
    flattened: int
    median_thickness: float
    max_thickness: float
    saturated: int


def write_gaussian_ply(gaussians: FlatGaussians, path: Path, *, sh_pad_degree: int | None = None) -> None:
    """Write ``gaussians`` as a 3DGS PLY, atomically and in blocks.

    Args:
        gaussians: at least one, all finite.
        path: the file, replaced if it exists.
        sh_pad_degree: write at least this degree of spherical harmonics, the missing ones zero; some
            importers accept only degree 3.

    Raises:
        SceneFileError: nothing to write, a parameter is not finite, or the file cannot be written.
    """
    if len(gaussians) == 0:
        raise SceneFileError(f"{path}: not written, as there are no Gaussians.")
    if not gaussians.is_finite():
        raise SceneFileError(f"{path}: not written, as some Gaussians hold values that are not finite.")
    if sh_pad_degree is not None and not 0 <= sh_pad_degree <= MAX_SH_DEGREE:
        raise SceneFileError(f"{path}: not written, as sh_pad_degree is {sh_pad_degree} but must be 0 to 3.")
    degree = max(gaussians.sh_degree, sh_pad_degree or 0)
    names = [*_POSITION, *_NORMAL, *_SH_DC, *_rest_names(degree), "opacity", *_scale_names(3), *_ROTATION]
    dtype = np.dtype([(name, "<f4") for name in names])
    element = PlyWriteElement("vertex", len(gaussians), dtype, _row_blocks(gaussians, degree, dtype))
    write_ply(path, [element])


def _row_blocks(gaussians: FlatGaussians, degree: int, dtype: np.dtype[np.void]) -> Iterator[np.ndarray]:
    rest_own = gaussians.sh.shape[1] - 1
    rest_file = (degree + 1) ** 2 - 1
    for start in range(0, len(gaussians), ROWS_AT_ONCE):
        part = slice(start, start + ROWS_AT_ONCE)
        n = len(gaussians.means_world[part])
        values = np.zeros((n, len(dtype.names or ())), dtype="<f4")
        values[:, 0:3] = gaussians.means_world[part]
        values[:, 6:9] = gaussians.sh[part, 0]
        rest = values[:, 9 : 9 + 3 * rest_file].reshape(n, 3, rest_file)
        rest[:, :, :rest_own] = gaussians.sh[part, 1:].transpose(0, 2, 1)
        values[:, 9 : 9 + 3 * rest_file] = rest.reshape(n, -1)
        tail = values[:, 9 + 3 * rest_file :]
        tail[:, 0] = gaussians.opacity_logits[part]
        tail[:, 1] = FLAT_LOG_SCALE
        tail[:, 2:4] = gaussians.log_scales[part]
        tail[:, 4:8] = gaussians.quats_wxyz[part]
        yield values.view(dtype)[:, 0]


def read_gaussian_ply(
    path: Path, *, two_scale_normal: Literal[0, 2] = 0
) -> tuple[FlatGaussians, ImportReport]:
    """Read a PLY of Gaussians, flat or not, by property name.

    Properties may come in any order and numeric type, ascii or binary; unknown ones are ignored. A Gaussian
    with three scales is flattened along its smallest one by relabelling its axes, which changes neither the
    directions of the other two nor their scales; a file of ours comes back bit for bit.

    Args:
        path: the file.
        two_scale_normal: which axis is the normal in a file with two scales: 0 as GaMeS writes it, 2 as
            2DGS does.

    Raises:
        SceneFileError: the file is not a PLY, is truncated, holds compressed or no Gaussians, lacks a
            property, or holds values that are not finite.
    """
    header = read_ply_header(path)
    vertex = header.element("vertex")
    if header.element("chunk") is not None or (vertex is not None and "packed_position" in vertex.names):
        raise SceneFileError(
            f"{path}: is a compressed PLY, which is not read yet; convert it to a standard 3DGS PLY first."
        )
    if vertex is None:
        raise SceneFileError(f"{path}: has no element 'vertex', so it holds no Gaussians.")
    rest_count, scale_count = _check_properties(path, vertex)
    if vertex.count == 0:
        raise SceneFileError(f"{path}: holds no Gaussians.")
    table = read_ply(path, ["vertex"])[1]["vertex"]
    means, quats = columns(table, _POSITION), columns(table, _ROTATION)
    scales = columns(table, _scale_names(scale_count))
    logits = columns(table, ["opacity"])[:, 0]
    infinite = np.isinf(logits)
    logits[infinite] = np.copysign(LARGEST_LOGIT, logits[infinite])
    colours = columns(table, [*_SH_DC, *(f"f_rest_{k}" for k in range(rest_count))])
    _check_values(
        path, {"position": means, "rotation": quats, "scale": scales, "opacity": logits, "colour": colours}
    )
    rest = colours[:, 3:].reshape(len(table), 3, rest_count // 3).transpose(0, 2, 1)
    sh = np.ascontiguousarray(np.concatenate([colours[:, None, :3], rest], axis=1))
    if scale_count == 3:
        quats, in_plane, thickness = _flatten(quats, scales)
    else:
        quats, thickness = _turn(quats, np.full(len(table), two_scale_normal)), np.empty(0)
        in_plane = scales
    gaussians = FlatGaussians(means, quats, in_plane, logits, sh)
    report = ImportReport(
        count=len(gaussians),
        sh_degree=gaussians.sh_degree,
        scale_count=scale_count,
        flattened=len(thickness),
        median_thickness=float(np.median(thickness)) if len(thickness) else 0.0,
        max_thickness=float(thickness.max()) if len(thickness) else 0.0,
        saturated=int(infinite.sum()),
    )
    return gaussians, report


def _rest_names(degree: int) -> list[str]:
    return [f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1))]


def _scale_names(count: int) -> list[str]:
    return [f"scale_{k}" for k in range(count)]


def _check_properties(path: Path, vertex: PlyElement) -> tuple[int, int]:
    """Numbers of f_rest and scale properties of an element that has all it needs."""
    names = set(vertex.names)
    rest_count = sum(name.startswith("f_rest_") for name in names)
    scale_count = 3 if "scale_2" in names else 2
    needed = [*_POSITION, *_SH_DC, "opacity", *_scale_names(scale_count), *_ROTATION]
    missing = [name for name in needed if name not in names]
    if missing:
        raise SceneFileError(
            f"{path}: is not a PLY of Gaussians; it lacks the property {', '.join(missing)}."
        )
    if rest_count not in {len(_rest_names(degree)) for degree in range(MAX_SH_DEGREE + 1)}:
        raise SceneFileError(
            f"{path}: has {rest_count} f_rest properties, but degrees 0 to 3 of spherical harmonics "
            "need 0, 9, 24 or 45."
        )
    needed += [f"f_rest_{k}" for k in range(rest_count)]
    missing = [name for name in needed if name not in names]
    if missing:
        raise SceneFileError(
            f"{path}: its f_rest properties are not numbered from 0; {missing[0]} is missing."
        )
    lists = [prop.name for prop in vertex.lists]
    if lists:
        raise SceneFileError(
            f"{path}: property '{lists[0]}' of element 'vertex' is a list; Gaussians have scalars only."
        )
    return rest_count, scale_count


def _check_values(path: Path, values: dict[str, np.ndarray]) -> None:
    for what, array in values.items():
        bad = int((~np.isfinite(array.reshape(len(array), -1))).any(axis=1).sum())
        if bad:
            raise SceneFileError(
                f"{path}: {bad} of {len(array)} Gaussians have no finite {what}; "
                "remove them and save the file again."
            )
    zero = int((values["rotation"] == 0).all(axis=1).sum())
    if zero:
        raise SceneFileError(
            f"{path}: {zero} of {len(values['rotation'])} Gaussians have a rotation of length zero."
        )


def _flatten(
    quats_wxyz: Float32[np.ndarray, "n 4"], log_scales: Float32[np.ndarray, "n 3"]
) -> tuple[Float32[np.ndarray, "n 4"], Float32[np.ndarray, "n 2"], Float32[np.ndarray, " m"]]:
    """Make the smallest axis the normal; also the thickness ratio of those that were not flat already.

    Axis 0 wins ties, and always where it holds our own flat scale, so that our own files stay as they are.
    """
    axis = np.where(log_scales[:, 0] == FLAT_LOG_SCALE, 0, np.argmin(log_scales, axis=1))
    order = (axis[:, None] + np.arange(3)) % 3
    turned = np.take_along_axis(log_scales, order, axis=1)
    in_plane = np.ascontiguousarray(turned[:, 1:])
    thick: Bool[np.ndarray, " n"] = turned[:, 0] > FLAT_LOG_SCALE
    ratios = np.exp(turned[thick, 0] - in_plane[thick].min(axis=1))
    return _turn(quats_wxyz, axis), in_plane, ratios


def _turn(quats_wxyz: Float32[np.ndarray, "n 4"], axis: Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n 4"]:
    """Quaternions of R P_axis; those of axis 0 keep every bit, and no length changes."""
    w, x, y, z = quats_wxyz.T
    a, b, c, d = _CYCLIC_TURNS[axis].T
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
