"""Photographs of the still life, and the ground truth of their pixels."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.color import to_bytes
from octasplat.engine.dataset.synthetic.config import SyntheticDatasetConfig
from octasplat.engine.dataset.synthetic.lit_scene import LitScene
from octasplat.engine.dataset.synthetic.synthetic_views import SyntheticView, directions_cam
from octasplat.engine.trace.triangle_bvh import TriangleHits

# Rays traced and shaded at a time: arrays of this many colors stay in the processor's cache.
_RAYS_PER_CHUNK = 1 << 15


@dataclass(frozen=True)
class RenderedPhotograph:
    """One view.

    Attributes:
        pixels: 8-bit display colors, RGB, or RGBA with straight alpha.
        depth_cam: z in the camera frame at pixel centres, in metres; 0 where nothing was hit.
        normals_world: Unit normals of the triangles at pixel centres, towards the camera; 0 where no hit.
        is_foreground: Whether a pixel's centre shows the table or a thing on it.
    """

    pixels: UInt8[np.ndarray, "height width channels"]
    depth_cam: Float32[np.ndarray, "height width"]
    normals_world: Float32[np.ndarray, "height width 3"]
    is_foreground: Bool[np.ndarray, "height width"]


class PhotographRenderer:
    """Renders photographs with one camera; ``render`` may be called from several threads."""

    def __init__(self, scene: LitScene, camera: pycolmap.Camera, config: SyntheticDatasetConfig) -> None:
        self._scene = scene
        self._config = config
        x, y = np.meshgrid(np.arange(config.width_px) + 0.5, np.arange(config.height_px) + 0.5)
        centres = np.stack([x, y], axis=-1).reshape(-1, 2)
        side = config.samples_per_side
        offsets = (np.arange(side) + 0.5) / side - 0.5
        self._offsets = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
        self._centres_cam = directions_cam(camera, centres)
        # All photographs share the lens, so its distortion is undone once; float32 keeps this small.
        self._samples_cam = np.concatenate(
            [
                directions_cam(camera, (part[:, None] + self._offsets).reshape(-1, 2))
                for part in np.array_split(centres, max(1, len(centres) // _RAYS_PER_CHUNK))
            ]
        )

    def render(self, view: SyntheticView) -> RenderedPhotograph:
        """Render the photograph of ``view`` and its ground truth."""
        height, width = self._config.height_px, self._config.width_px
        life = self._scene.unlit
        origins, directions = rays_world(view, self._centres_cam)
        hits = self._scene.trace(origins, directions)
        hit = hits.is_hit
        depth = np.where(hit, hits.distances, np.float32(0))
        normals = np.where(hit[:, None], life.face_normals[hits.faces], np.float32(0))
        away = np.sum(normals * directions, axis=1) > 0
        normals[away] *= -1
        return RenderedPhotograph(
            self.render_pixels(view),
            depth.reshape(height, width),
            normals.reshape(height, width, 3),
            (hit & life.face_is_foreground[hits.faces]).reshape(height, width),
        )

    def render_pixels(self, view: SyntheticView) -> UInt8[np.ndarray, "height width channels"]:
        """Render the photograph of ``view`` alone."""
        config = self._config
        return to_bytes(self._display_colors(view)).reshape(config.height_px, config.width_px, -1)

    def _display_colors(self, view: SyntheticView) -> Float32[np.ndarray, "n channels"]:
        """Return box-filtered display colors of all pixels."""
        samples = len(self._offsets)
        step = max(1, _RAYS_PER_CHUNK // samples) * samples
        parts = []
        for start in range(0, len(self._samples_cam), step):
            origins, directions = rays_world(view, self._samples_cam[start : start + step])
            hits = self._scene.trace(origins, directions)
            colors = self._scene.shade_hits(hits, origins, directions).reshape(-1, samples, 3)
            if self._config.transparent:
                foreground = self._is_foreground(hits).reshape(-1, samples, 1)
                coverage = foreground.mean(axis=1, dtype=np.float32)
                summed = (colors * foreground).mean(axis=1, dtype=np.float32)
                parts.append(np.concatenate([summed / np.maximum(coverage, 1e-6), coverage], axis=1))
            else:
                parts.append(colors.mean(axis=1, dtype=np.float32))
        return np.concatenate(parts)

    def _is_foreground(self, hits: TriangleHits) -> Bool[np.ndarray, " n"]:
        return hits.is_hit & self._scene.unlit.face_is_foreground[hits.faces]


def rays_world(
    view: SyntheticView, directions: Float32[np.ndarray, "n 3"]
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Return world origins and directions of rays with z = 1 in the camera frame.

    Distances along them, counted in lengths of the direction, are therefore z-depths.
    """
    origins = np.empty_like(directions)
    origins[:] = view.centre_world
    # Three multiplications and sums, not a matrix product: its order of summation may vary with the library.
    rotation: Float[np.ndarray, "3 3"] = view.rotation_cam_from_world.astype(np.float32)
    world = (
        directions[:, :1] * rotation[0] + directions[:, 1:2] * rotation[1] + directions[:, 2:] * rotation[2]
    )
    return origins, np.ascontiguousarray(world)
