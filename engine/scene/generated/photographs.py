"""Photographs of the still life, and what is known exactly about each of their pixels."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Bool, Float, Float32, UInt8

from octasplat.engine.colour import to_bytes
from octasplat.engine.scene.generated.cameras import View, directions_cam
from octasplat.engine.scene.generated.config import GeneratedSceneConfig
from octasplat.engine.scene.generated.tracing import LitScene
from octasplat.engine.trace.meshes import TriangleHits

# Rays traced and shaded at a time: arrays of this many colours stay in the processor's cache.
_CHUNK_RAYS = 1 << 15


@dataclass(frozen=True)
class Photograph:
    """One view.

    Attributes:
        pixels: 8-bit display colours, RGB, or RGBA with straight alpha.
        depth_cam: z in the camera frame at pixel centres, in metres; 0 where nothing was hit.
        normals_world: Unit normals of the triangles at pixel centres, towards the camera; 0 where no hit.
        is_object: Whether a pixel's centre shows the table or a thing on it.
    """

    pixels: UInt8[np.ndarray, "height width channels"]
    depth_cam: Float32[np.ndarray, "height width"]
    normals_world: Float32[np.ndarray, "height width 3"]
    is_object: Bool[np.ndarray, "height width"]


class Photographer:
    """Takes photographs with one lens; ``take`` may be called from several threads."""

    def __init__(self, scene: LitScene, camera: pycolmap.Camera, config: GeneratedSceneConfig) -> None:
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
                for part in np.array_split(centres, max(1, len(centres) // _CHUNK_RAYS))
            ]
        )

    def take(self, view: View) -> Photograph:
        """The photograph of ``view`` and its ground truth."""
        height, width = self._config.height_px, self._config.width_px
        life = self._scene.still_life
        origins, directions = rays_world(view, self._centres_cam)
        hits = self._scene.trace(origins, directions)
        hit = hits.hit
        depth = np.where(hit, hits.distances, np.float32(0))
        normals = np.where(hit[:, None], life.face_normals[hits.faces], np.float32(0))
        away = np.sum(normals * directions, axis=1) > 0
        normals[away] *= -1
        return Photograph(
            to_bytes(self._pixels(view)).reshape(height, width, -1),
            depth.reshape(height, width),
            normals.reshape(height, width, 3),
            (hit & life.face_is_object[hits.faces]).reshape(height, width),
        )

    def _pixels(self, view: View) -> Float32[np.ndarray, "n channels"]:
        """Box-filtered display colours of all pixels."""
        samples = len(self._offsets)
        step = max(1, _CHUNK_RAYS // samples) * samples
        parts = []
        for start in range(0, len(self._samples_cam), step):
            origins, directions = rays_world(view, self._samples_cam[start : start + step])
            hits = self._scene.trace(origins, directions)
            colours = self._scene.colours(hits, origins, directions).reshape(-1, samples, 3)
            if self._config.transparent:
                shown = self._shows_object(hits).reshape(-1, samples, 1)
                coverage = shown.mean(axis=1, dtype=np.float32)
                summed = (colours * shown).mean(axis=1, dtype=np.float32)
                parts.append(np.concatenate([summed / np.maximum(coverage, 1e-6), coverage], axis=1))
            else:
                parts.append(colours.mean(axis=1, dtype=np.float32))
        return np.concatenate(parts)

    def _shows_object(self, hits: TriangleHits) -> Bool[np.ndarray, " n"]:
        return hits.hit & self._scene.still_life.face_is_object[hits.faces]


def rays_world(
    view: View, directions: Float32[np.ndarray, "n 3"]
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Origins and directions in the world frame of rays with z = 1 in the camera frame.

    Distances along them, counted in lengths of the direction, are therefore z-depths.
    """
    origins = np.empty_like(directions)
    origins[:] = view.centre_world
    # Three multiplications and sums, not a matrix product: its order of summation may vary with the library.
    rotation: Float[np.ndarray, "3 3"] = view.rotation.astype(np.float32)
    world = (
        directions[:, :1] * rotation[0] + directions[:, 1:2] * rotation[1] + directions[:, 2:] * rotation[2]
    )
    return origins, np.ascontiguousarray(world)
