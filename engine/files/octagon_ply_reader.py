"""The Gaussians of a mesh PLY of octagons, as far as such a file holds them: one color each, in bytes."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import ConfigError, SceneFileError
from octasplat.engine.core.ply_container import columns, read_ply
from octasplat.engine.files.channel_columns import ChannelChoice, select_channel_columns
from octasplat.engine.files.encodings import logits_from_bytes, sh0_from_rgb
from octasplat.engine.files.gaussian_ply import declared_channels
from octasplat.engine.files.mesh_ply import COLORS, PATTERNS, VERTEX
from octasplat.engine.files.octagon_recovery import (
    OCTAGONS_PER_BLOCK,
    OctagonOrder,
    edited_octagons_error,
    gaussians_from_octagons,
    is_octagon_ply,
    missing_gaussians_notes,
)
from octasplat.engine.files.registry import Importer, register
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.flattening import CloudBlocks, GaussianCloud, join_blocks, row_slices
from octasplat.engine.gaussians.octagon import SIDES
from octasplat.engine.geometry.imported_mesh import SCENE_SIZE_KEY

_ROWS_PER_OCTAGON = (*COLORS, "alpha", "gid", "radius")


def read(path: Path, channels: ChannelChoice = "own") -> GaussianCloud:
    """Read the Gaussians in the order of their numbers, if the octagons are as they were exported.

    Raises:
        SceneFileError: no mesh PLY of ours, its octagons were edited, so that only the scene they came from
            can bring them back, or there is no such channel.
    """
    return join_blocks(_read_blocks(path, channels), path)


def _read_blocks(path: Path, channels: ChannelChoice = "own") -> CloudBlocks:
    header, tables = read_ply(path, ["vertex"])
    table = tables["vertex"]
    known = {name for name, _ in VERTEX}
    missing = sorted(known - {"s", "t"} - set(table.dtype.names or ()))
    if missing:
        raise SceneFileError(
            f"{path}: its octagons lack the property {', '.join(missing)}; save the mesh with its attributes."
        )
    if any(table.dtype[name] != np.uint8 for name in (*COLORS, "alpha")):
        raise SceneFileError(f"{path}: its colors are not bytes; bring it back with octasplat edit --mesh.")
    if len(table) == 0 or len(table) % SIDES:
        raise edited_octagons_error(path)
    others = (name for name in table.dtype.names or () if name not in known)
    requested = select_channel_columns(path, declared_channels(header.comments), others, channels)
    sizes = [comment.split()[1] for comment in header.comments if comment.startswith(f"{SCENE_SIZE_KEY} ")]
    stated = int(sizes[0]) if sizes and sizes[0].isdecimal() else 0
    octagons = table.reshape(-1, SIDES)
    count = len(octagons)
    notes = missing_gaussians_notes(stated, count)
    order = OctagonOrder(octagons["gid"][:, 0].astype(np.float32))
    if not order.are_unique:
        raise edited_octagons_error(path)

    def block(rows: slice) -> GaussianCloud:
        return replace(_read_octagons(path, octagons[rows], requested), notes=notes)

    found = ((order.places(rows), block(rows)) for rows in row_slices(count, OCTAGONS_PER_BLOCK))
    return CloudBlocks(count, found)


def _read_octagons(path: Path, rows: np.ndarray, channels: Mapping[str, tuple[str, ...]]) -> GaussianCloud:
    """Return the Gaussians of a table of octagons and their corners.

    Raises:
        SceneFileError: they were edited.
    """
    same = all((rows[name] == rows[name][:, :1]).all() for name in _ROWS_PER_OCTAGON)
    if not same or (rows["corner"] != np.arange(SIDES)).any():
        raise edited_octagons_error(path)
    first = np.ascontiguousarray(rows[:, 0])
    corners = columns(rows.reshape(-1), ("x", "y", "z")).reshape(-1, SIDES, 3)
    means, quats, log_scales = gaussians_from_octagons(corners, columns(first, ("radius",))[:, 0], path)
    try:
        named = Channels({name: columns(first, own) for name, own in channels.items()})
    except ConfigError as error:
        raise SceneFileError(f"{path}: {error}") from error
    return GaussianCloud(
        means, quats, log_scales, logits_from_bytes(first["alpha"]),
        sh0_from_rgb(columns(first, COLORS) / np.float32(255)), channels=named,
    )  # fmt: skip


register(
    Importer(
        "mesh-ply",
        PATTERNS,
        "octagon mesh as it was exported, one color for each Gaussian",
        read,
        is_octagon_ply,
        read_blocks=_read_blocks,
        holds_channels=True,
    )
)
