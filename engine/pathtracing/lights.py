"""Lights of a stage as arrays for the kernels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.pathtracing.environment import (
    EnvironmentMap,
    build_environment_sampler,
    mean_irradiance,
)
from octasplat.engine.pathtracing.kernels.environment_light import eval_environment_array
from octasplat.engine.pathtracing.kernels.kernel_args import (
    DIRECTIONAL,
    ENVIRONMENT,
    MESH,
    POINT,
    RECTANGLE,
    SPHERE,
    SPOT,
    LightArrays,
)
from octasplat.engine.pathtracing.kernels.texture import TEXTURE_COLUMNS
from octasplat.engine.pathtracing.mesh_shapes import primitive_shape
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Light,
    PointLight,
    RectangleLight,
    SpotLight,
)

LEAST_RADIUS = 1e-15
"""Balls of light that are smaller are points: the radiance of them would leave what numbers hold."""


class Opacity(NamedTuple):
    """What is there of a surface.

    Attributes:
        factor: share of it, times that of the texture.
        texture: number of a texture, -1 for none.
        cutoff: the surface is there where the opacity reaches this; -1 for none.
        uses_vertex_alpha: whether the alpha of its corners is multiplied by it.
    """

    factor: float = 1.0
    texture: int = -1
    cutoff: float = -1.0
    uses_vertex_alpha: int = 0


WHOLE = Opacity()


@dataclass(frozen=True)
class EmissiveMesh:
    """Triangles of equal emission.

    Attributes:
        corners_world: of each.
        corner_uv: texture coordinates.
        corner_alpha: factor of the opacity.
        rgb_linear: radiance.
        texture: number of a texture that is multiplied by it, -1 for none.
        opacity: of the surface; what is not there does not shine.
    """

    corners_world: Float32[np.ndarray, "f 3 3"]
    corner_uv: Float32[np.ndarray, "f 3 2"]
    corner_alpha: Float32[np.ndarray, "f 3"]
    rgb_linear: Float64[np.ndarray, "3"]
    texture: int = -1
    opacity: Opacity = WHOLE


class _MeshTables(NamedTuple):
    """Triangles of all emissive meshes, and the areas before each as shares of its mesh.

    ``rows`` has the first and last row of each mesh in ``cdf``, and its first triangle.
    """

    rows: Int64[np.ndarray, "m 3"]
    cdf: Float64[np.ndarray, " c"]
    corners_world: Float32[np.ndarray, "f 3 3"]
    uv: Float32[np.ndarray, "f 3 2"]
    alpha: Float32[np.ndarray, "f 3"]


def _mesh_tables(meshes: Sequence[EmissiveMesh]) -> _MeshTables:
    rows, sums = np.zeros((len(meshes), 3), np.int64), [np.zeros(0)]
    corners, uv = [np.zeros((0, 3, 3), np.float32)], [np.zeros((0, 3, 2), np.float32)]
    alpha = [np.zeros((0, 3), np.float32)]
    face, row = 0, 0
    for m, mesh in enumerate(meshes):
        own = triangle_areas(mesh.corners_world)
        rows[m] = row, row + len(own), face
        sums.append(np.concatenate([[0.0], np.cumsum(own) / own.sum()]))
        corners.append(mesh.corners_world)
        uv.append(mesh.corner_uv)
        alpha.append(mesh.corner_alpha)
        # a mesh's sums have one row more than it has triangles
        face, row = face + len(own), row + len(own) + 1
    return _MeshTables(rows, *(np.concatenate(parts) for parts in (sums, corners, uv, alpha)))


def build_light_arrays(
    lights: tuple[Light, ...],
    up_world: Float64[np.ndarray, "3"],
    environment: EnvironmentMap | None = None,
    meshes: Sequence[EmissiveMesh] = (),
    texels_linear: Float32[np.ndarray, "x 3"] | None = None,
    texture_sizes: Int64[np.ndarray, "k 6"] | None = None,
    *,
    found_by_paths: bool = True,
) -> LightArrays:
    """Return arrays of the lights, emissive meshes and the environment, in this order.

    Args:
        lights: of the stage.
        up_world: the stage's up.
        environment: light from all around.
        meshes: that shine.
        texels_linear: of the textures of the meshes' light.
        texture_sizes: likewise.
        found_by_paths: whether scattered paths that meet a light count beside the light queries of surfaces:
            not where Gaussians keep off the one that keep nothing off the other.
    """
    tables = _mesh_tables(meshes)
    count = len(lights) + len(meshes) + (environment is not None)
    kinds, visibility, adds = np.zeros((3, count), np.int32)
    casts_shadows, lights_relit, lights_meshes = np.ones((3, count), np.int32)
    positions, axes, rgb, sides_u, sides_v = np.zeros((5, count, 3))
    areas, cosines = np.zeros(count), np.tile([0.0, 1.0], (count, 1))
    textures, rows = np.full(count, -1, np.int32), np.zeros((count, 3), np.int64)
    opacities, opacity_cutoffs, opacity_textures = np.ones(count), np.full(count, -1.0), textures.copy()
    uses_vertex_alpha = np.zeros(count, np.int32)
    for l, light in enumerate(lights):
        color = srgb_to_linear(np.array(light.color_srgb))
        adds[l], casts_shadows[l] = light.adds_light, light.casts_shadows
        lights_relit[l] = not light.only_shadows
        lights_meshes[l] = light.lights_meshes and not light.only_shadows
        if not isinstance(light, DirectionalLight):
            positions[l] = light.position
        if not isinstance(light, PointLight):
            axes[l] = np.array(light.direction) / np.linalg.norm(light.direction)
        if isinstance(light, PointLight | SpotLight):
            kinds[l], rgb[l] = POINT, color * light.intensity
            if isinstance(light, SpotLight):
                kinds[l] = SPOT
                cosines[l] = np.cos(np.radians([light.outer_degrees, light.inner_degrees]))
            elif light.radius > LEAST_RADIUS:
                areas[l] = np.pi * light.radius**2
                # intensity = radiance times the disc's area
                kinds[l], rgb[l], visibility[l] = SPHERE, rgb[l] / areas[l], light.visible
        elif isinstance(light, DirectionalLight):
            kinds[l], rgb[l] = DIRECTIONAL, color * light.irradiance
        else:
            kinds[l], rgb[l], visibility[l] = RECTANGLE, color * light.radiance, light.visible
            sides_u[l], sides_v[l] = rectangle_sides(light, up_world)
            areas[l] = light.width * light.height
    for l, mesh in enumerate(meshes, len(lights)):
        own = triangle_areas(mesh.corners_world)
        kinds[l], rgb[l], areas[l], visibility[l], adds[l] = MESH, mesh.rgb_linear, own.sum(), 1, 1
        # mean of the surface, for estimates of its distance
        positions[l] = own @ mesh.corners_world.mean(axis=1, dtype=np.float64) / own.sum()
        textures[l], rows[l] = mesh.texture, tables.rows[l - len(lights)]
        opacities[l], opacity_textures[l], opacity_cutoffs[l], uses_vertex_alpha[l] = mesh.opacity
    takes = casts_shadows * (1 - adds)
    radiance, frame = np.zeros((1, 1, 3), np.float32), np.eye(3)  # the kernels need a map: one black pixel
    if environment is not None:
        radiance, frame = environment.radiance_linear, environment.frame
        kinds[-1], rgb[-1], visibility[-1] = ENVIRONMENT, mean_irradiance(radiance), 1
    # light from where nothing keeps it off is not found by paths that things keep off
    visibility *= casts_shadows * found_by_paths
    sampler = build_environment_sampler(radiance)
    return LightArrays(
        kinds=kinds,
        positions_world=positions,
        axes=axes,
        rgb_linear=rgb,
        sides_u=sides_u,
        sides_v=sides_v,
        areas=areas,
        cosines=cosines,
        is_hittable=visibility,
        adds_light=adds,
        takes_light=takes,
        any_takes_nothing=not takes.all(),
        lights_relit=lights_relit,
        lights_meshes=lights_meshes,
        casts_shadows=casts_shadows,
        textures=textures,
        opacities=opacities,
        opacity_textures=opacity_textures,
        opacity_cutoffs=opacity_cutoffs,
        uses_vertex_alpha=uses_vertex_alpha,
        mesh_rows=rows,
        mesh_cdf=tables.cdf,
        mesh_corners_world=tables.corners_world,
        mesh_uv=tables.uv,
        mesh_alpha=tables.alpha,
        texels_linear=np.zeros((0, 3), np.float32) if texels_linear is None else texels_linear,
        texture_sizes=np.zeros((0, TEXTURE_COLUMNS), np.int64) if texture_sizes is None else texture_sizes,
        environment_linear=radiance,
        environment_row_cdf=sampler.row_cdf,
        environment_column_cdf=sampler.column_cdf,
        environment_probabilities=sampler.probabilities,
        environment_frame=frame,
    )


def triangle_areas(corners: Float32[np.ndarray, "f 3 3"]) -> Float64[np.ndarray, " f"]:
    """Return the areas of triangles."""
    sides = (corners[:, 1:] - corners[:, :1]).astype(np.float64)
    areas: np.ndarray = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    return areas


def rectangle_sides(
    light: RectangleLight, up_world: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Return a rectangle's level side and its other one; their cross product points where it shines."""
    facing = np.array(light.direction) / np.linalg.norm(light.direction)
    level = np.cross(up_world / np.linalg.norm(up_world), facing)
    if np.linalg.norm(level) < 1e-6:  # facing up or down: any level direction will do, the same each time
        level = np.cross(np.eye(3)[np.argmin(np.abs(facing))], facing)
    level /= np.linalg.norm(level)
    return level * light.width, np.cross(facing, level) * light.height


def light_triangles(light: Light, up_world: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "f 3 3"] | None:
    """Return the triangles of a visible light; None of an invisible one."""
    if light.only_shadows:
        return None
    if isinstance(light, PointLight) and light.radius > LEAST_RADIUS and light.visible:
        ball = primitive_shape("sphere")
        corners = ball.vertices[ball.faces] * light.radius + np.array(light.position)
        return np.asarray(corners.astype(np.float32))
    if not (isinstance(light, RectangleLight) and light.visible):
        return None
    u, v = rectangle_sides(light, up_world)
    centre = np.array(light.position)
    a, b, c, d = (
        centre - u / 2 - v / 2,
        centre + u / 2 - v / 2,
        centre + u / 2 + v / 2,
        centre - u / 2 + v / 2,
    )
    return np.array([[a, b, c], [a, c, d]], np.float32)


def eval_environment_map(
    lights: LightArrays, directions_world: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """Return linear radiance from unit directions, and the density of sampling these."""
    radiance, density = np.empty((len(directions_world), 3)), np.empty(len(directions_world))
    eval_environment_array(lights, directions_world, radiance, density)
    return radiance, density
