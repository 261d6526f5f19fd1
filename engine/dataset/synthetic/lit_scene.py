"""A scene of objects in Embree, lit once: irradiance of each vertex, and colors of hits."""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Float32

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset.synthetic.kernels import noise
from octasplat.engine.dataset.synthetic.object_scene import Lamp, ObjectScene
from octasplat.engine.trace.triangle_bvh import TriangleBvh, TriangleHits

# Fixed, so that equal sums are summed alike on every machine.
_CHUNKS = 16
THREADS = min(8, os.cpu_count() or 1)

_SPECULAR_STRENGTH = np.array([9.0, 8.2, 7.0], np.float32)
_ZENITH, _HORIZON, _INDIRECT_LIGHT = (
    np.array(c) for c in ([0.34, 0.42, 0.6], [0.5, 0.5, 0.52], [0.15, 0.125, 0.1])
)
_EXPOSURE = 1.1
# Shadow rays start this far above the surface, so that a facet does not shade itself.
_SHADOW_RAY_OFFSET = 1.5e-3
# Columns of the vertex attributes that a hit interpolates.
_UV, _XYZ, _NORMAL, _LIGHT, _LAMP_SEEN = slice(0, 2), slice(2, 5), slice(5, 8), slice(8, 11), 11


class LitScene:
    """A scene ready to be photographed; its methods may be called from several threads."""

    def __init__(self, unlit: ObjectScene) -> None:
        self.unlit = unlit
        self._mesh = TriangleBvh(unlit.vertices, unlit.faces, threads=1)
        light, lamp_seen = self._vertex_irradiance()
        self._attributes = np.ascontiguousarray(
            np.concatenate(
                [unlit.uv, unlit.texture_xyz, unlit.vertex_normals, light, lamp_seen[:, None]],
                axis=1,
            ),
            dtype=np.float32,
        )

    def trace(
        self, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]
    ) -> TriangleHits:
        """Return the first hits of rays in the world frame; directions need not have unit length."""
        return self._mesh.closest(RayBatch(origins, directions))

    def _shadow_transmittance(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> np.ndarray:
        """Return 1.0 where nothing is between an origin and the origin plus its direction, else 0.0."""
        return 1.0 - self._mesh.occluded(RayBatch(origins, directions, t_max=1.0))

    def _vertex_irradiance(self) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]]:
        """Return the irradiance of each vertex (lamp, sky, constant indirect) and the lamp's visibility."""
        pieces = np.array_split(np.arange(len(self.unlit.vertices)), _CHUNKS)
        with ThreadPoolExecutor(THREADS) as pool:
            parts = list(pool.map(self._irradiance_at, pieces))
        return np.concatenate([light for light, _ in parts]), np.concatenate(
            [visibility for _, visibility in parts]
        )

    def _irradiance_at(
        self, which: np.ndarray
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, " n"]]:
        normals = self.unlit.vertex_normals[which].astype(np.float64)
        starts = self.unlit.vertices[which] + _SHADOW_RAY_OFFSET * normals
        light, visibility = np.zeros_like(starts), np.zeros(len(starts))
        lamp_points = _lamp_points(self.unlit.lamp, 36)
        for lamp_point in lamp_points:
            way = lamp_point - starts
            squared = np.sum(way * way, axis=1)
            cosine = np.maximum(np.sum(normals * way, axis=1), 0) / np.sqrt(squared)
            free = np.zeros(len(starts))
            lit = np.flatnonzero(cosine > 0)
            free[lit] = self._shadow_transmittance(starts[lit], way[lit])
            visibility += free / len(lamp_points)
            light += (free * cosine / squared)[:, None] * self.unlit.lamp.intensity / len(lamp_points)
        directions = _sphere_directions(112)
        for direction in directions:
            cosine = np.maximum(np.sum(normals * direction, axis=1), 0)
            up = np.flatnonzero(cosine > 0)
            free = np.zeros((len(starts), 1))
            free[up, 0] = self._shadow_transmittance(
                starts[up], np.broadcast_to(self.unlit.sky_distance * direction, (len(up), 3))
            )
            sky = np.zeros(3) if direction[2] <= 0 else _sky_radiance(direction[None])[0]
            # 4 pi / n steradians a direction, over pi for a diffuse surface
            light += (4 / len(directions)) * cosine[:, None] * (free * sky + (1 - free) * _INDIRECT_LIGHT)
        return light.astype(np.float32), visibility.astype(np.float32)

    def shade_hits(
        self, hits: TriangleHits, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]
    ) -> Float32[np.ndarray, "n 3"]:
        """Return the display colors in [0, 1] of hits."""
        radiance = np.empty_like(directions)
        missed = ~hits.is_hit
        radiance[missed] = _sky_radiance(directions[missed])
        hit = np.flatnonzero(hits.is_hit)
        faces = hits.faces[hit]
        at = np.empty((len(hit), self._attributes.shape[1]), np.float32)
        u, v = np.ascontiguousarray(hits.barycentrics[hit].T)
        noise.interpolate_attributes(self._attributes, self.unlit.faces, faces, u, v, at)
        kinds = self.unlit.face_object[faces]
        for kind in np.unique(kinds):
            scene_object = self.unlit.objects[kind]
            mine = np.flatnonzero(kinds == kind)
            here = at[mine]
            albedo = scene_object.material(
                np.ascontiguousarray(here[:, _XYZ]), np.ascontiguousarray(here[:, _UV])
            )
            bright = albedo * here[:, _LIGHT]
            if scene_object.specular:
                rays = hit[mine]
                places = origins[rays] + hits.distances[rays, None] * directions[rays]
                bright += (
                    np.float32(scene_object.specular)
                    * _phong_highlight(self.unlit.lamp, places, directions[rays], here[:, _NORMAL])[:, None]
                    * (here[:, _LAMP_SEEN, None] * _SPECULAR_STRENGTH)
                )
            radiance[hit[mine]] = bright
        return _tonemap(radiance)


def _phong_highlight(
    lamp: Lamp,
    places: Float32[np.ndarray, "n 3"],
    directions: Float32[np.ndarray, "n 3"],
    normals: Float32[np.ndarray, "n 3"],
) -> Float32[np.ndarray, " n"]:
    """Return the lamp's highlight on a glossy surface: a Phong lobe about the mirrored ray."""
    ahead, upwards, to_lamp = (
        _normalize_vectors(a) for a in (directions, normals, lamp.position_world.astype(np.float32) - places)
    )
    mirrored = ahead - 2 * np.sum(ahead * upwards, axis=1, keepdims=True) * upwards
    return np.maximum(np.sum(mirrored * to_lamp, axis=1), 0) ** 90


def _normalize_vectors(vectors: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _lamp_points(lamp: Lamp, count: int) -> Float[np.ndarray, "n 3"]:
    """Return points spread evenly (by the golden angle) over the lamp's disc."""
    k = np.arange(count)
    radius, angle = lamp.radius * np.sqrt((k + 0.5) / count), k * np.pi * (3 - np.sqrt(5))
    down = -lamp.position_world / np.linalg.norm(lamp.position_world)
    side = np.cross(down, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    return (
        lamp.position_world
        + np.outer(radius * np.cos(angle), side)
        + np.outer(radius * np.sin(angle), np.cross(down, side))
    )


def _sphere_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Return ``count`` unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(count)
    z, angle = 1 - (2 * k + 1) / count, k * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def _sky_radiance(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Return the radiance of the open roof."""
    height = np.clip(directions[:, 2:] / np.linalg.norm(directions, axis=1, keepdims=True), 0, 1)
    return _HORIZON + (_ZENITH - _HORIZON) * height


def _tonemap(radiance: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
    """Return sRGB-encoded colors of linear light, with a soft shoulder so that nothing clips hard."""
    return linear_to_srgb(1 - np.exp(radiance * np.float32(-_EXPOSURE)))
