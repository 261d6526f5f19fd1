"""Materials baked into the textures of a surface, as glTF 2.0 has them."""

import numpy as np
from jaxtyping import Bool, Float32, Float64

from octasplat.engine.core.color import linear_to_srgb, to_bytes
from octasplat.engine.gaussians.materials import AMBIENT, MATERIAL_WIDTHS
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.geometry.triangle_mesh import MaterialMaps, TriangleMesh
from octasplat.engine.surface.bake_colors import BakeTarget
from octasplat.engine.surface.tangents import vertex_tangents, world_to_tangent
from octasplat.engine.surface.texture import TextureLayout
from octasplat.engine.trace.protocol import TraceResult

MIN_NORMAL_COSINE = 0.1
"""Normals that lean farther from the surface than this (the cosine) are laid back: a renderer that lights a
surface by a normal that looks away from the viewer shows black."""


def material_features(gaussians: FlatGaussians) -> Float32[np.ndarray, "n 6"]:
    """Return the materials' channels side by side, as a tracer takes them for :data:`MATERIAL_TARGET`.

    The last is the share of the light from all around that arrives, all of it where the scene does not say.
    """
    ambient = gaussians.channels.get(AMBIENT)
    if ambient is None:
        ambient = np.ones((len(gaussians), 1), np.float32)
    return np.concatenate([*(gaussians.channels[name] for name in MATERIAL_WIDTHS), ambient], axis=1)


def _blended_materials(traced: TraceResult) -> Float32[np.ndarray, "r 9"]:
    blended = np.clip(traced.features[:, :6] / traced.alpha[:, None], 0.0, 1.0)
    return np.concatenate([blended, traced.normal_world / traced.alpha[:, None]], axis=1)


MATERIAL_TARGET = BakeTarget(9, _blended_materials)
"""Linear base color, metallic, roughness, share of the light from all around, and the normal in the world
(not of unit length)."""


def with_materials(
    layout: TextureLayout,
    baked: Float32[np.ndarray, "n 9"],
    known: Bool[np.ndarray, " n"],
    light_frame: Float64[np.ndarray, "3 3"],
) -> TriangleMesh:
    """Return the unwrapped mesh with baked material textures.

    Args:
        layout: of the texture.
        baked: what :data:`MATERIAL_TARGET` gives for the pixels of the layout.
        known: pixels whose normals are known; the others get that of the surface.
        light_frame: right, up and forward of the light around the scene, as rows in the world.
    """
    tangents = vertex_tangents(layout.mesh)
    surface = layout.normals_world.astype(np.float64)
    local = world_to_tangent(
        _limit_normals(baked[:, 6:].astype(np.float64), surface, known), surface, layout.interpolate(tangents)
    )
    packed = baked[:, [5, 4, 3]]  # channels as in glTF: occlusion red, roughness green, metallic blue
    return TriangleMesh(
        layout.mesh.vertices_world,
        layout.mesh.faces,
        uv=layout.mesh.uv,
        texture_srgb=to_bytes(layout.image(linear_to_srgb(baked[:, :3]))),
        normals_world=layout.mesh.normals_world,
        materials=MaterialMaps(
            to_bytes(layout.image(packed)),
            to_bytes(layout.image((0.5 * local + 0.5).astype(np.float32))),
            tangents,
            light_frame,
        ),
    )


def _limit_normals(
    blended_world: Float64[np.ndarray, "n 3"],
    surface_world: Float64[np.ndarray, "n 3"],
    known: Bool[np.ndarray, " n"],
) -> Float64[np.ndarray, "n 3"]:
    """Return unit normals, limited in their angle to the surface's."""
    length = np.linalg.norm(blended_world, axis=1, keepdims=True)
    normals = np.where(
        known[:, None] & (length > 1e-3), blended_world / np.maximum(length, 1e-3), surface_world
    )
    rise = (normals * surface_world).sum(axis=1, keepdims=True)
    level = normals - rise * surface_world
    flat = np.linalg.norm(level, axis=1, keepdims=True)
    # on the cone of the least cosine, in the same direction
    laid = MIN_NORMAL_COSINE * surface_world + np.sqrt(1 - MIN_NORMAL_COSINE**2) * level / np.maximum(
        flat, 1e-9
    )
    laid = np.where(flat > 1e-6, laid, surface_world)
    return np.asarray(np.where(rise < MIN_NORMAL_COSINE, laid, normals))
