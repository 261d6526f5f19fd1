"""The native file: flat Gaussians in the PLY layout of the 3DGS family.

One element ``vertex``, all float32: ``x y z``, ``nx ny nz`` (zeros), ``f_dc_0..2``, ``f_rest_*``
channel-major (all red, then green, then blue), ``opacity`` (logit), ``scale_0..2`` (ln of the standard
deviations) and ``rot_0..3`` (w, x, y, z). The flat axis, the normal r1, is axis 0 with scale ln 1e-5, so that
every viewer of 3DGS files shows the scene. A comment ``near_world`` gives the distance from a camera at which
it begins to be seen, as in training, ``pixel_rad`` the angle of a pixel that it was trained with, and
``turned_beyond`` which normals, that point outwards, are turned, so that one file is one picture. A comment
``origin_world`` is to be added to all positions where coordinates are large, and ``georeference_matrix``
takes what comes out to metres, see :mod:`octasplat.engine.core.georeference`.

Named channels come last, ``metallic`` or ``albedo_0..2``, and a comment ``octasplat_channel albedo 3`` says
of each that it is one.
"""

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from octasplat.engine.core.errors import ConfigError, SceneFileError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.core.ply_container import (
    MAX_PROPERTIES,
    PlyElement,
    PlyWriteElement,
    columns,
    read_ply,
    read_ply_header,
    write_ply,
)
from octasplat.engine.files import ply_positions
from octasplat.engine.files.channel_columns import ChannelChoice, select_channel_columns
from octasplat.engine.files.encodings import MAX_SH_DEGREE, dropped_sh_message
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.octagon_recovery import is_octagon_ply
from octasplat.engine.files.place_comments import parse_place, place_comments
from octasplat.engine.files.ply_dialects import (
    FLAT_DIALECT_MESSAGE,
    MIP_FILTER,
    UNUSED_SCALE_MESSAGE,
    has_unused_third_scale,
    ignored_properties_message,
    refuse_anchors,
    with_mip_filter,
)
from octasplat.engine.files.ply_positions import POSITION
from octasplat.engine.files.range_losses import find_thickness_losses
from octasplat.engine.files.registry import Exporter, Importer, register
from octasplat.engine.files.splat_rows import select_for_export
from octasplat.engine.gaussians.channels import Channels, column_names, stack_channels
from octasplat.engine.gaussians.flattening import (
    FLAT_LOG_SCALE,
    CloudBlocks,
    GaussianCloud,
    ImportReport,
    flatten,
    join_blocks,
    row_slices,
)
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import UNKNOWN_METADATA, SceneMetadata

PlyDialect = Literal["3dgs", "2dgs", "games"]
"""What the scales of a PLY mean.

``3dgs``: the normal is the axis of the smallest of three; two are read as 2DGS writes them. ``2dgs`` (2D
Gaussian Splatting, and gsplat's, whose third scale means nothing): the first two lie in the plane, the normal
is axis 2. ``games`` (GaMeS, REdiSplats): the last two lie in the plane, the normal is axis 0.
"""
_NUMBERS = ("near_world", "pixel_rad", "turned_beyond")
"""Those of :class:`SceneMetadata` that a comment of the same name gives."""
_NORMAL = ("nx", "ny", "nz")
_SH_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_CHANNEL = "octasplat_channel"
_POINT_COLORS = ("red", "green", "blue", "alpha")
"""Beside the harmonics, for viewers of points: they say nothing more."""
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")


def write_gaussian_ply(
    gaussians: FlatGaussians,
    path: Path,
    *,
    sh_pad_degree: int | None = None,
    facts: SceneMetadata = UNKNOWN_METADATA,
) -> None:
    """Write ``gaussians`` as a 3DGS PLY, atomically and in blocks.

    Args:
        gaussians: at least one, all finite.
        path: the file, replaced if it exists.
        sh_pad_degree: write at least this degree of spherical harmonics, the missing ones zero; some
            importers accept only degree 3.
        facts: what is known of the scene as a whole, kept as comments.

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
    names = [*POSITION, *_NORMAL, *_SH_DC, *_rest_names(degree), "opacity", *_scale_names(3), *_ROTATION]
    widths = gaussians.channels.widths
    names += [column for name, width in widths.items() for column in column_names(name, width)]
    dtype = np.dtype([(name, "<f4") for name in names])
    element = PlyWriteElement("vertex", len(gaussians), dtype, _row_blocks(gaussians, degree, dtype))
    write_ply(path, [element], [*metadata_comments(facts), *channel_comments(widths)])


def read_ply_metadata(path: Path) -> SceneMetadata:
    """Return what a file says of its scene as a whole.

    Raises:
        SceneFileError: the file is damaged, or says something that is no number.
    """
    # Reversed, so that the first comment of a name counts
    header = read_ply_header(path)
    metadata = dict(comment.partition(" ")[::2] for comment in reversed(header.comments))
    known: dict[str, float] = {}
    for name in _NUMBERS:
        if (value := metadata.get(name)) is None:
            continue
        try:
            known[name] = max(float(value), 0.0)
        except ValueError:
            known[name] = math.nan
        if not math.isfinite(known[name]):  # max() passes on what is not a number
            raise SceneFileError(f"{path}: its comment {name} is {value!r}, which is no number.")
    origin, georeference = parse_place(path, metadata)
    if ply_positions.asks_for_origin(header):
        origin = ply_positions.origin_of_positions(read_ply(path, ["vertex"])[1]["vertex"])
    facts = SceneMetadata(**known, origin_world=origin, georeference=georeference)
    return replace(facts, turned_beyond=min(facts.turned_beyond, 1.0))  # it is a cosine


def metadata_comments(facts: SceneMetadata) -> list[str]:
    """Return the comments of a PLY that say what is known of its scene as a whole."""
    known = [(name, getattr(facts, name)) for name in _NUMBERS]
    numbers = [f"{name} {float(value)!r}" for name, value in known if value > 0]
    return [*numbers, *place_comments(facts.origin_world, facts.georeference)]


def _row_blocks(gaussians: FlatGaussians, degree: int, dtype: np.dtype[np.void]) -> Iterator[np.ndarray]:
    rest_own = gaussians.sh.shape[1] - 1
    rest_file = (degree + 1) ** 2 - 1
    for part in row_slices(len(gaussians)):
        n = len(gaussians.means_world[part])
        values = np.zeros((n, len(dtype.names or ())), dtype="<f4")  # normals stay 0
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
        if gaussians.channels:
            tail[:, 8:] = stack_channels(gaussians.view(part).channels)
        yield values.view(dtype)[:, 0]


def read_gaussian_ply(
    path: Path,
    *,
    dialect: PlyDialect = "3dgs",
    drop_invalid: bool = False,
    channels: ChannelChoice = "own",
    folder: Path | None = None,
) -> tuple[FlatGaussians, ImportReport]:
    """Read a PLY of Gaussians, flat or not, by property name.

    Properties may come in any order and numeric type, ascii or binary. A Gaussian with three scales is
    flattened along its smallest one; a file of ours comes back bit for bit.

    Args:
        path: the file.
        dialect: what its scales mean.
        drop_invalid: leave out Gaussians with values that are not finite, instead of refusing the file.
        channels: which properties become channels beside the parameters.
        folder: for files that hold a large scene, see :func:`octasplat.engine.gaussians.flattening.flatten`.

    Raises:
        SceneFileError: the file is not a PLY, is truncated, holds compressed or no Gaussians, lacks a
            property, or holds values that are not finite.
    """
    found = read_ply_blocks(path, channels, dialect)
    return flatten(found, path, drop_invalid=drop_invalid, folder=folder)


def read_ply_cloud(
    path: Path, channels: ChannelChoice = "own", dialect: PlyDialect = "3dgs"
) -> GaussianCloud:
    """Return the Gaussians of a PLY as they are in the file, found by property name.

    Args:
        path: the file.
        channels: which properties become channels beside the parameters.
        dialect: what its scales mean.

    Raises:
        SceneFileError: the file is not a PLY, is truncated, holds compressed or no Gaussians, or lacks a
            property.
    """
    return join_blocks(read_ply_blocks(path, channels, dialect), path)


def read_ply_blocks(path: Path, channels: ChannelChoice = "own", dialect: PlyDialect = "3dgs") -> CloudBlocks:
    """Return what :func:`read_ply_cloud` does, some thousands at a time.

    A binary file is mapped; the rows of a text file are in memory.

    Raises:
        SceneFileError: likewise.
    """
    header = read_ply_header(path)
    vertex = header.element("vertex")
    if header.element("chunk") is not None or (vertex is not None and "packed_position" in vertex.names):
        raise SceneFileError(
            f"{path}: is a compressed PLY; octasplat import turns it into a standard 3DGS PLY."
        )
    if vertex is None:
        raise SceneFileError(f"{path}: has no element 'vertex', so it holds no Gaussians.")
    degree, scale_count = _check_properties(path, vertex)
    if vertex.count == 0:
        raise SceneFileError(f"{path}: holds no Gaussians.")
    table = read_ply(path, ["vertex"])[1]["vertex"]
    unnamed = [name for name in vertex.names if name != MIP_FILTER]
    named = select_channel_columns(path, declared_channels(header.comments), unnamed, channels)
    origin = ply_positions.origin_of_positions(table) if ply_positions.asks_for_origin(header) else NO_ORIGIN
    normal_axis, notes = _normal_axis(dialect, scale_count), dropped_sh_message(degree)
    used = {*POSITION, *_NORMAL, *_ROTATION, *_SH_DC, "opacity", MIP_FILTER, *_scale_names(scale_count)}
    used |= {*_POINT_COLORS, *(column for own in named.values() for column in own)}
    ignored = [name for name in vertex.names if name not in used and not name.startswith("f_rest_")]
    if ignored:
        notes = (*notes, ignored_properties_message(ignored))
    if dialect == "3dgs" and scale_count == 3 and has_unused_third_scale(table, _scale_names(3)):
        normal_axis, notes = 2, (*notes, UNUSED_SCALE_MESSAGE)
    if dialect == "3dgs" and scale_count == 2:
        notes = (*notes, FLAT_DIALECT_MESSAGE)

    def block(rows: slice) -> GaussianCloud:
        cloud = _read_rows(path, table[rows], degree, scale_count, named, origin)
        cloud = replace(cloud, notes=notes, normal_axis=normal_axis)
        filtered = MIP_FILTER in vertex.names
        return with_mip_filter(cloud, columns(table[rows], [MIP_FILTER])[:, 0]) if filtered else cloud

    return CloudBlocks(vertex.count, ((rows, block(rows)) for rows in row_slices(vertex.count)))


def _read_rows(
    path: Path,
    table: np.ndarray,
    degree: int,
    scale_count: int,
    named: Mapping[str, tuple[str, ...]],
    origin: Origin,
) -> GaussianCloud:
    """Return the Gaussians of some rows about a local origin, with channels of these columns."""
    retained = (min(degree, MAX_SH_DEGREE) + 1) ** 2 - 1
    each = (degree + 1) ** 2 - 1
    names = [f"f_rest_{color * each + k}" for color in range(3) for k in range(retained)]
    colors = columns(table, [*_SH_DC, *names])
    rest = colors[:, 3:].reshape(len(table), 3, retained).transpose(0, 2, 1)
    try:
        found = Channels({name: columns(table, own) for name, own in named.items()})
    except ConfigError as error:
        raise SceneFileError(f"{path}: {error}") from error
    return GaussianCloud(
        means_world=ply_positions.positions_about(table, origin),
        quats_wxyz=columns(table, _ROTATION),
        log_scales=columns(table, _scale_names(scale_count)),
        opacity_logits=columns(table, ["opacity"])[:, 0],
        sh=np.ascontiguousarray(np.concatenate([colors[:, None, :3], rest], axis=1)),
        channels=found,
    )


def _normal_axis(dialect: PlyDialect, scale_count: int) -> Literal[0, 2] | None:
    if dialect == "games":
        return 0
    return 2 if dialect == "2dgs" or scale_count == 2 else None


def declared_channels(comments: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the channels that a PLY's comments name, with their properties."""
    declared: dict[str, tuple[str, ...]] = {}
    left = MAX_PROPERTIES  # a file has no more columns than that, whatever its comments say
    for words in (comment.split() for comment in comments):
        if len(words) == 3 and words[0] == _CHANNEL and words[2].isdecimal() and len(words[2]) < 6:
            width = int(words[2])
            if 0 < width <= left:
                declared[words[1]] = column_names(words[1], width)
                left -= width
    return declared


def channel_comments(widths: Mapping[str, int]) -> tuple[str, ...]:
    """Return the comments that declare which properties of a PLY are channels."""
    return tuple(f"{_CHANNEL} {name} {width}" for name, width in widths.items())


def _rest_names(degree: int) -> list[str]:
    return [f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1))]


def _scale_names(count: int) -> list[str]:
    return [f"scale_{k}" for k in range(count)]


def _check_properties(path: Path, vertex: PlyElement) -> tuple[int, int]:
    """Return the degree of the harmonics and the number of scales of an element that has all it needs."""
    names = set(vertex.names)
    rest_count = sum(name.startswith("f_rest_") for name in names)
    scale_count = 3 if "scale_2" in names else 2
    needed = [*POSITION, *_SH_DC, "opacity", *_scale_names(scale_count), *_ROTATION]
    missing = [name for name in needed if name not in names]
    # Before the missing properties are told, as this says more
    refuse_anchors(path, names)
    if missing:
        raise SceneFileError(
            f"{path}: is not a PLY of Gaussians; it lacks the property {', '.join(missing)}."
        )
    degree = math.isqrt(rest_count // 3 + 1) - 1
    if rest_count != len(_rest_names(degree)):
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
    return degree, scale_count


def _export(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians that are not fainter than ``options.min_opacity``."""
    chosen = select_for_export(gaussians, path, options)
    write_gaussian_ply(chosen, path, sh_pad_degree=options.sh_pad_degree, facts=options.facts)
    return (path,)


def _recognises(head: bytes) -> bool:
    return head.startswith(b"ply") and b"packed_position" not in head and not is_octagon_ply(head)


register(
    Importer(
        "gaussians",
        ("*.ply",),
        "Gaussians in the PLY layout of 3DGS",
        read_ply_cloud,
        _recognises,
        read_blocks=read_ply_blocks,
        holds_channels=True,
    )
)
_NAMED_DIALECTS: tuple[tuple[PlyDialect, str], ...] = (
    ("2dgs", "Gaussians in the PLY layout of 2DGS or gsplat's 2DGS, the normal being the third axis"),
    ("games", "Gaussians in the PLY layout of GaMeS or REdiSplats, the normal being the first axis"),
)
for _dialect, _what in _NAMED_DIALECTS:
    register(
        Importer(
            _dialect,
            ("*.ply",),
            _what,
            functools.partial(read_ply_cloud, dialect=_dialect),
            read_blocks=functools.partial(read_ply_blocks, dialect=_dialect),
            holds_channels=True,
        )
    )
register(
    Exporter(
        "gaussians",
        ("*.ply",),
        "Gaussians as a 3DGS PLY, for splat viewers and for octasplat itself",
        _export,
        holds_channels=True,
        holds_harmonics=True,
        holds_origin=True,
        find_losses=functools.partial(find_thickness_losses, "gaussians"),
    )
)
