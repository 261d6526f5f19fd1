"""Octagons of a scene in batches, with texture coordinates and colors, for all mesh formats."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.splat_rows import iterate_blocks
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.flattening import row_slices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import (
    corner_directions,
    cut_octagon_radii,
    octagon_corners_world,
)
from octasplat.engine.gaussians.rows import allocate_rows, overwrite_rows

MAX_FLOAT_ID = 1 << 24
"""Numbers below this are exact in float32, the only type that mesh editors keep for custom attributes."""
BATCH_SIZE = 16384


@dataclass(frozen=True)
class OctagonBatch:
    """Some octagons, ready to be written.

    Attributes:
        ids: number of each Gaussian in the scene given to the exporter.
        corners_world: corners, in world units.
        uv: texture coordinates of the corners; the texture spans sqrt(Q) standard deviations to each side, so
            a fainter Gaussian, whose octagon is smaller, uses less of it.
        rgb_srgb: color of the constant harmonic in [0, 1], display values.
        opacities: in (0, 1].
        radii: corner radii in standard deviations.
        normals_world: unit normals, from where the corners run anticlockwise.
        channels: what else is known of the Gaussians.
    """

    ids: Int[np.ndarray, " n"]
    corners_world: Float32[np.ndarray, "n 8 3"]
    uv: Float32[np.ndarray, "n 8 2"]
    rgb_srgb: Float32[np.ndarray, "n 3"]
    opacities: Float32[np.ndarray, " n"]
    radii: Float32[np.ndarray, " n"]
    normals_world: Float32[np.ndarray, "n 3"]
    channels: Channels


class OctagonSoup:
    """The octagons of a scene, computed batch by batch.

    Gaussians whose octagon has no size, or fainter than ``options.min_opacity``, have no place in it.

    Attributes:
        ids: numbers of the Gaussians that have an octagon, ascending.
        scene_size: number of Gaussians in the scene.
        q: the chi-square quantile that the radii come from.
        min_opacity: the least opacity of a Gaussian with an octagon.
    """

    def __init__(
        self,
        gaussians: FlatGaussians,
        path: Path,
        options: ExportOptions,
        alpha_cutoff: float | None = None,
        *,
        is_numbered: bool = True,
    ) -> None:
        """Pick the Gaussians to write.

        Args:
            gaussians: the scene.
            path: the file, only named in errors.
            options: of the export.
            alpha_cutoff: each octagon is only as large as the ellipse in which alpha reaches this.
            is_numbered: whether the file has the numbers of the Gaussians, of which there are only so many.

        Raises:
            SceneFileError: no octagons, values that are not finite, or too many Gaussians to number.
        """
        if not gaussians.is_finite():
            raise SceneFileError(f"{path}: not written, as some Gaussians hold values that are not finite.")
        if is_numbered and len(gaussians) > MAX_FLOAT_ID:
            raise SceneFileError(
                f"{path}: not written; a mesh can number {MAX_FLOAT_ID} Gaussians, and the scene has "
                f"{len(gaussians)}. Export it in parts, as a Gaussian PLY, or as a GLB without numbers "
                "(--no-ids, --for-viewers)."
            )
        self.q = options.q
        self.min_opacity = options.min_opacity
        self.scene_size = len(gaussians)
        self._path = path
        self._gaussians = gaussians
        self._alpha_cutoff = alpha_cutoff
        is_shown = [
            (self._radii(block.opacities) > 0.0) & (block.opacities >= options.min_opacity)
            for block in iterate_blocks(gaussians.with_base_color_only())
        ]
        self.ids = np.flatnonzero(np.concatenate(is_shown)) if is_shown else np.zeros(0, np.int64)
        # There are no more of them than this holds.
        self.ids = self.ids.astype(np.int32)
        if not len(self.ids):
            raise SceneFileError(
                f"{path}: not written, as none of the {len(gaussians)} Gaussians is opaque enough for an "
                "octagon."
            )

    def __len__(self) -> int:
        return len(self.ids)

    def _radii(self, opacities: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
        return cut_octagon_radii(opacities, self.q, self._alpha_cutoff)

    @property
    def channel_widths(self) -> dict[str, int]:
        """Return the channels of the batches, with their widths."""
        return self._gaussians.channels.widths

    @property
    def means_world(self) -> Float32[np.ndarray, "n 3"]:
        """Return the centres of the octagons, world units, in the order of ``ids``."""
        return self._gaussians.means_world[self.ids]

    def batch(self, places: slice | Int[np.ndarray, " n"]) -> OctagonBatch:
        """Return the octagons at ``places``, which count along ``ids``."""
        ids = self.ids[places]
        if len(ids) <= BATCH_SIZE:
            return self._batch(ids)
        # What it takes to compute one is some times what it comes to.
        batch: OctagonBatch | None = None
        for rows in row_slices(len(ids), BATCH_SIZE):
            part = self._batch(ids[rows])
            if batch is None:
                batch = allocate_rows(part, len(ids))
            overwrite_rows(batch, rows, part)
        assert batch is not None
        return batch

    def _batch(self, ids: Int[np.ndarray, " n"]) -> OctagonBatch:
        part = self._gaussians.with_base_color_only().select(ids)
        opacities = part.opacities
        radii = self._radii(opacities)
        with np.errstate(over="ignore", invalid="ignore"):
            corners = octagon_corners_world(part, radii)
        if not np.isfinite(corners).all():
            raise SceneFileError(
                f"{self._path}: not written, as some Gaussians are too large for float32 coordinates."
            )
        half = 0.5 * radii.astype(np.float64) / np.sqrt(self.q)
        uv = 0.5 + half[:, None, None] * corner_directions()
        rgb = np.clip(part.base_rgb_srgb, 0.0, 1.0)
        channels = {name: array[ids] for name, array in self._gaussians.channels.items()}
        return OctagonBatch(
            ids=ids,
            corners_world=corners,
            uv=uv.astype(np.float32),
            rgb_srgb=rgb,
            opacities=opacities,
            radii=radii,
            normals_world=np.ascontiguousarray(part.rotations[:, :, 0]),
            channels=Channels(channels),
        )

    def batches(self) -> Iterator[OctagonBatch]:
        """Yield all octagons in the order of ``ids``, a few thousand at a time."""
        for start in range(0, len(self.ids), BATCH_SIZE):
            yield self.batch(slice(start, start + BATCH_SIZE))
