"""The Gaussians of a GLB of octagons, as far as such a file holds them.

Geometry comes from the corners, the radius of an octagon in standard deviations from its texture coordinates,
color and opacity from ``COLOR_0``. Harmonics and Gaussians too faint for an octagon are not in the file.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.files import glb_container
from octasplat.engine.files.channel_columns import ChannelChoice, select_channel_columns
from octasplat.engine.files.encodings import sh0_from_rgb
from octasplat.engine.files.glb_container import GlbFile
from octasplat.engine.files.octagon_recovery import (
    TOLERANCE,
    edited_octagons_error,
    gaussians_from_octagons,
    missing_gaussians_notes,
)
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.flattening import GaussianCloud
from octasplat.engine.gaussians.octagon import SIDES, corner_directions
from octasplat.engine.gaussians.rows import concatenate_rows, select_rows
from octasplat.engine.geometry.imported_mesh import Q_KEY, SCENE_SIZE_KEY

UNLIT = "KHR_materials_unlit"


def octagon_q(file: GlbFile) -> float | None:
    """Return the chi-square quantile of a file's octagons; None where it has none, or has them lit."""
    q = file.document.get("asset", {}).get("extras", {}).get(Q_KEY)
    return float(q) if q is not None and UNLIT in file.document.get("extensionsUsed", []) else None


def read_octagons(file: GlbFile, path: Path, q: float, channels: ChannelChoice) -> GaussianCloud:
    """Read the Gaussians in the order of their numbers, if the octagons are as they were exported.

    Raises:
        SceneFileError: they were edited, so that only the scene they came from can bring them back; or there
            is no such channel.
        KeyError, IndexError, TypeError, ValueError: the document is damaged.
    """
    parts = [_read_primitive(file, path, q, channels, *found) for found in file.primitives()]
    ids = np.concatenate([own for _, own in parts])
    cloud = select_rows(concatenate_rows([part for part, _ in parts]), np.argsort(ids, kind="stable"))
    stated = int(file.document["asset"]["extras"].get(SCENE_SIZE_KEY, 0))
    return replace(cloud, notes=missing_gaussians_notes(stated, len(ids)))


def _read_primitive(
    file: GlbFile,
    path: Path,
    q: float,
    channels: ChannelChoice,
    matrix: Float64[np.ndarray, "4 4"],
    primitive: Mapping[str, Any],
) -> tuple[GaussianCloud, Float32[np.ndarray, " n"]]:
    """Return the Gaussians of a primitive, and their numbers in the scene."""
    attributes = primitive["attributes"]
    # From glTF's y up to our y down
    turned = np.diag([1.0, -1.0, -1.0, 1.0]) @ file.about_origin(matrix)
    vertices = file.array(attributes["POSITION"], np.float64) @ turned[:3, :3].T + turned[:3, 3]
    offset = 2.0 * file.array(attributes["TEXCOORD_0"], np.float64) - 1.0
    if len(vertices) % SIDES or len(offset) != len(vertices):
        raise edited_octagons_error(path)
    corners = vertices.astype(np.float32).reshape(-1, SIDES, 3)
    offset = offset.reshape(-1, SIDES, 2)
    share = np.linalg.norm(offset, axis=2).mean(axis=1)  # radius / sqrt(Q)
    if np.abs(offset - share[:, None, None] * corner_directions()).max(initial=0.0) > TOLERANCE:
        raise edited_octagons_error(path)
    radii = (share * np.sqrt(q)).astype(np.float32)
    means, quats, log_scales = gaussians_from_octagons(corners, radii, path)
    # All corners of an octagon have the same values.
    rgba = file.array(attributes["COLOR_0"], np.float32)[::SIDES]
    with np.errstate(divide="ignore"):
        logits = np.log(rgba[:, 3].astype(np.float64)) - np.log1p(-rgba[:, 3].astype(np.float64))
    columns = {name[1:].lower(): number for name, number in attributes.items() if name[0] == "_"}
    requested = select_channel_columns(
        path, glb_container.declared_channel_attributes(file.document), columns, channels
    )
    named = {
        name: np.concatenate([file.array(columns[column], np.float32)[::SIDES] for column in own], axis=1)
        for name, own in requested.items()
    }
    # Without numbers, the order of the file is taken.
    ids = np.arange(len(corners), dtype=np.float32)
    if "_GID" in attributes:
        ids = file.array(attributes["_GID"], np.float32)[::SIDES, 0]
    cloud = GaussianCloud(
        means, quats, log_scales, logits.astype(np.float32), sh0_from_rgb(linear_to_srgb(rgba[:, :3])),
        channels=Channels(named),
    )  # fmt: skip
    return cloud, ids
