"""The Gaussians of a GLB of octagons, as far as such a file holds them.

Geometry comes from the corners, the radius of an octagon in standard deviations from its texture coordinates,
color and opacity from ``COLOR_0``. Harmonics and Gaussians too faint for an octagon are not in the file.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.files import glb_container, glb_parts
from octasplat.engine.files.channel_columns import ChannelChoice, select_channel_columns
from octasplat.engine.files.encodings import sh0_from_rgb
from octasplat.engine.files.glb_container import GlbFile
from octasplat.engine.files.octagon_recovery import (
    OCTAGONS_PER_BLOCK,
    TOLERANCE,
    OctagonOrder,
    edited_octagons_error,
    gaussians_from_octagons,
    missing_gaussians_notes,
)
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.flattening import CloudBlocks, GaussianCloud, row_slices
from octasplat.engine.gaussians.octagon import SIDES, corner_directions
from octasplat.engine.geometry.imported_mesh import Q_KEY, SCENE_SIZE_KEY

UNLIT = "KHR_materials_unlit"


def octagon_q(file: GlbFile) -> float | None:
    """Return the chi-square quantile of a file's octagons; None where it has none, or has them lit."""
    q = glb_container.asset_extras(file.document).get(Q_KEY)
    return float(q) if q is not None and UNLIT in file.document.get("extensionsUsed", []) else None


def read_octagons(file: GlbFile, path: Path, q: float, channels: ChannelChoice) -> CloudBlocks:
    """Read the Gaussians in the order of their numbers, if the octagons are as they were exported.

    Raises:
        SceneFileError: they were edited, so that only the scene they came from can bring them back; or there
            is no such channel.
        KeyError, IndexError, TypeError, ValueError: the document is damaged.
    """
    parts = [_Octagons(file, path, q, channels, *found) for found in file.primitives()]
    if any(part.channel_names != parts[0].channel_names for part in parts):
        raise ValueError("its primitives differ in channels")
    count = sum(part.count for part in parts)
    stated = int(file.document["asset"]["extras"].get(SCENE_SIZE_KEY, 0))
    part = glb_parts.part_note(file.document)
    # of a part of a scene, others have the rest
    notes = (*missing_gaussians_notes(0 if part else stated, count), *part)
    order = OctagonOrder(np.concatenate([part.ids() for part in parts]))

    def blocks() -> Iterator[tuple[Int[np.ndarray, " n"], GaussianCloud]]:
        start = 0
        for part in parts:
            for rows in row_slices(part.count, OCTAGONS_PER_BLOCK):
                places = order.places(slice(start + rows.start, start + rows.stop))
                yield places, replace(part.read(rows), notes=notes)
            start += part.count

    return CloudBlocks(count, blocks())


class _Octagons:
    """The octagons of a primitive.

    Attributes:
        count: number of them.
        channel_names: names of the channels that are wanted.
    """

    def __init__(
        self,
        file: GlbFile,
        path: Path,
        q: float,
        channels: ChannelChoice,
        matrix: Float64[np.ndarray, "4 4"],
        primitive: Mapping[str, Any],
    ) -> None:
        """Look at what there is; raises as :func:`read_octagons` does."""
        self._file, self._path, self._q = file, path, q
        self._attributes = primitive["attributes"]
        # From glTF's y up to our y down
        self._turned = np.diag([1.0, -1.0, -1.0, 1.0]) @ file.about_origin(matrix)
        columns = {name[1:].lower(): number for name, number in self._attributes.items() if name[0] == "_"}
        declared = glb_container.declared_channel_attributes(file.document, columns)
        requested = select_channel_columns(path, declared, columns, channels)
        self._channels = {name: [columns[column] for column in own] for name, own in requested.items()}
        self.channel_names = tuple(self._channels)
        vertices = file.count(self._attributes["POSITION"])
        others = [self._attributes[name] for name in ("TEXCOORD_0", "COLOR_0")]
        others += [number for own in self._channels.values() for number in own]
        others += [self._attributes["_GID"]] if "_GID" in self._attributes else []
        if vertices % SIDES or any(file.count(number) != vertices for number in others):
            raise edited_octagons_error(path)
        self.count = vertices // SIDES

    def ids(self) -> Float32[np.ndarray, " n"]:
        """Return the numbers of the Gaussians in the scene; without numbers those of the file's order."""
        if "_GID" not in self._attributes:
            return np.arange(self.count, dtype=np.float32)
        return self._first_corners(self._attributes["_GID"], slice(0, self.count))[:, 0]

    def read(self, rows: slice) -> GaussianCloud:
        """Return the Gaussians of some octagons.

        Raises:
            SceneFileError: they were edited.
        """
        turned, corner_rows = self._turned, slice(rows.start * SIDES, rows.stop * SIDES)
        positions = self._file.array(self._attributes["POSITION"], np.float64, corner_rows)
        vertices = positions @ turned[:3, :3].T + turned[:3, 3]
        corners = vertices.astype(np.float32).reshape(-1, SIDES, 3)
        offset = 2.0 * self._file.array(self._attributes["TEXCOORD_0"], np.float64, corner_rows) - 1.0
        offset = offset.reshape(-1, SIDES, 2)
        share = np.linalg.norm(offset, axis=2).mean(axis=1)  # radius / sqrt(Q)
        if np.abs(offset - share[:, None, None] * corner_directions()).max(initial=0.0) > TOLERANCE:
            raise edited_octagons_error(self._path)
        radii = (share * np.sqrt(self._q)).astype(np.float32)
        means, quats, log_scales = gaussians_from_octagons(corners, radii, self._path)
        rgba = self._first_corners(self._attributes["COLOR_0"], rows)
        with np.errstate(divide="ignore"):
            logits = np.log(rgba[:, 3].astype(np.float64)) - np.log1p(-rgba[:, 3].astype(np.float64))
        named = {
            name: np.concatenate([self._first_corners(number, rows) for number in own], axis=1)
            for name, own in self._channels.items()
        }
        return GaussianCloud(
            means, quats, log_scales, logits.astype(np.float32), sh0_from_rgb(linear_to_srgb(rgba[:, :3])),
            channels=Channels(named),
        )  # fmt: skip

    def _first_corners(self, number: int, rows: slice) -> Float32[np.ndarray, "n w"]:
        """Return an attribute of which all corners of an octagon have the same value."""
        return self._file.array(number, np.float32, slice(rows.start * SIDES, rows.stop * SIDES, SIDES))
