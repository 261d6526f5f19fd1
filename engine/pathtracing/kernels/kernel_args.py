"""Arguments of the path tracer's kernels that describe a scene: named tuples of arrays."""

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.trace.kernels.triangles import EmbreeQuery

Vec3: TypeAlias = tuple[float, float, float]
"""A point or a direction."""
Rgb: TypeAlias = tuple[float, float, float]
"""Linear red, green and blue."""
POINT, SPOT, DIRECTIONAL, RECTANGLE, ENVIRONMENT, SPHERE, MESH = 0, 1, 2, 3, 4, 5, 6
"""Kinds of lights."""


class SurfaceArrays(NamedTuple):
    """All triangles of a stage.

    Attributes:
        corners_world: of each face.
        corner_normals: shading normals at the corners, unit vectors.
        corner_uv: texture coordinates at the corners, (0, 0) at the upper left.
        material_ids: row of each face in :class:`MaterialArrays`.
        corner_rgb_linear: colors of the corners; no rows at all where no mesh has any.
        corner_alpha: factor of the opacity at the corners; likewise.
    """

    corners_world: Float32[np.ndarray, "f 3 3"]
    corner_normals: Float32[np.ndarray, "f 3 3"]
    corner_uv: Float32[np.ndarray, "f 3 2"]
    material_ids: Int32[np.ndarray, " f"]
    corner_rgb_linear: Float32[np.ndarray, "g 3 3"]
    corner_alpha: Float32[np.ndarray, "h 3"]


class MaterialArrays(NamedTuple):
    """``m`` materials.

    Attributes:
        kinds: which of the kinds of :mod:`octasplat.engine.pathtracing.kernels.surface`.
        colors_linear: base color, reflectance or tint.
        metallic: share of the metal.
        roughness: perceptual.
        iors: index of refraction.
        absorption: per world unit.
        clear_coats: share of the surface under a clear coat.
        clear_coat_roughness: perceptual.
        clear_coat_textures: number of a texture, -1 for none.
        clear_coat_roughness_textures: likewise.
        priorities: of glass in glass, -1 for none.
        substrates: how the ground shares light with the coat.
        energy_compensation: whether light that facets throw at each other is kept.
        coat_tables: which of the tables the coat has; of rough glass that of entering, leaving has the next.
        opacities: share of the surface that is there, times that of the texture.
        opacity_textures: number of a texture, -1 for none.
        opacity_cutoffs: the surface is there where the opacity reaches this, else not; -1 for none.
        uses_vertex_alpha: whether the opacity changes with the corners.
        color_textures: number of a texture, -1 for none.
        metallic_roughness_textures: likewise.
        normal_textures: likewise.
        normal_scales: factor of their slopes.
        uses_vertex_color: whether the corners' colors count.
        light_ids: number of the light that a shining surface is, -1 for none.
        ggx_albedo: table of facets that reflect everything.
        coat_albedo: tables of dielectrics' surfaces.
        coat_mean_albedo: their means.
        texels_linear: all textures' values, one texture after another.
        texture_sizes: of each first texel, height and width, how it goes on beyond its edges, across and
            down, as places in :data:`.texture.WRAP_MODES`, and 1 where its pixels are blocks, else 0.
    """

    kinds: Int32[np.ndarray, " m"]
    colors_linear: Float64[np.ndarray, "m 3"]
    metallic: Float64[np.ndarray, " m"]
    roughness: Float64[np.ndarray, " m"]
    iors: Float64[np.ndarray, " m"]
    absorption: Float64[np.ndarray, "m 3"]
    clear_coats: Float64[np.ndarray, " m"]
    clear_coat_roughness: Float64[np.ndarray, " m"]
    clear_coat_textures: Int32[np.ndarray, " m"]
    clear_coat_roughness_textures: Int32[np.ndarray, " m"]
    priorities: Int32[np.ndarray, " m"]
    substrates: Int32[np.ndarray, " m"]
    energy_compensation: Int32[np.ndarray, " m"]
    coat_tables: Int32[np.ndarray, " m"]
    opacities: Float64[np.ndarray, " m"]
    opacity_textures: Int32[np.ndarray, " m"]
    opacity_cutoffs: Float64[np.ndarray, " m"]
    uses_vertex_alpha: Int32[np.ndarray, " m"]
    color_textures: Int32[np.ndarray, " m"]
    metallic_roughness_textures: Int32[np.ndarray, " m"]
    normal_textures: Int32[np.ndarray, " m"]
    normal_scales: Float64[np.ndarray, " m"]
    uses_vertex_color: Int32[np.ndarray, " m"]
    light_ids: Int32[np.ndarray, " m"]
    ggx_albedo: Float64[np.ndarray, "a c"]
    coat_albedo: Float64[np.ndarray, "t a c"]
    coat_mean_albedo: Float64[np.ndarray, "t a 2"]
    texels_linear: Float32[np.ndarray, "x 3"]
    texture_sizes: Int64[np.ndarray, "k 6"]


class LightArrays(NamedTuple):
    """``l`` lights: those of the stage, shining meshes, and the environment where there is one.

    Attributes:
        kinds: which of the kinds of :mod:`octasplat.engine.pathtracing.kernels.lights`.
        positions_world: of points and spots; centres of rectangles, balls and meshes.
        axes: unit vectors: the way that the light goes, or a rectangle faces.
        rgb_linear: intensity, irradiance or radiance; of the environment pi times its mean radiance.
        sides_u: one side of a rectangle.
        sides_v: the other side.
        areas: of rectangles and meshes; of balls that of their disc.
        cosines: of a spot's outer and inner angle.
        is_hittable: whether rays meet the light, so that it counts for those too.
        adds_light: whether the light is added to shadowed Gaussians.
        takes_light: whether its shadows take light from them.
        any_takes_nothing: whether some do not.
        lights_relit: whether it lights relit Gaussians.
        lights_meshes: whether it lights meshes, and Gaussians with materials.
        casts_shadows: whether anything keeps it off.
        textures: of meshes, -1 for none.
        opacities: of meshes, see :class:`MaterialArrays`, as the next three.
        opacity_textures: number of a texture, -1 for none.
        opacity_cutoffs: -1 for none.
        uses_vertex_alpha: whether the opacity changes with the corners.
        mesh_rows: of meshes: first and last row of their sums, and first triangle.
        mesh_cdf: cumulative shares of the triangles' areas, from 0 to 1 for each mesh.
        mesh_corners_world: of the triangles of all meshes.
        mesh_uv: likewise.
        mesh_alpha: likewise, factor of the opacity at the corners.
        texels_linear: see :class:`MaterialArrays`, as the next one.
        texture_sizes: of each first texel, height and width, how it goes on beyond its edges, across and
            down, as places in :data:`.texture.WRAP_MODES`, and 1 where its pixels are blocks, else 0.
        environment_linear: the map, one black pixel without one.
        environment_row_cdf: see :class:`octasplat.engine.pathtracing.environment.EnvironmentSampler`, as
            the next two.
        environment_column_cdf: cumulative shares within each row.
        environment_probabilities: share of each pixel.
        environment_frame: rows are right, up, forward of the map.
    """

    kinds: Int32[np.ndarray, " l"]
    positions_world: Float64[np.ndarray, "l 3"]
    axes: Float64[np.ndarray, "l 3"]
    rgb_linear: Float64[np.ndarray, "l 3"]
    sides_u: Float64[np.ndarray, "l 3"]
    sides_v: Float64[np.ndarray, "l 3"]
    areas: Float64[np.ndarray, " l"]
    cosines: Float64[np.ndarray, "l 2"]
    is_hittable: Int32[np.ndarray, " l"]
    adds_light: Int32[np.ndarray, " l"]
    takes_light: Int32[np.ndarray, " l"]
    any_takes_nothing: bool
    lights_relit: Int32[np.ndarray, " l"]
    lights_meshes: Int32[np.ndarray, " l"]
    casts_shadows: Int32[np.ndarray, " l"]
    textures: Int32[np.ndarray, " l"]
    opacities: Float64[np.ndarray, " l"]
    opacity_textures: Int32[np.ndarray, " l"]
    opacity_cutoffs: Float64[np.ndarray, " l"]
    uses_vertex_alpha: Int32[np.ndarray, " l"]
    mesh_rows: Int64[np.ndarray, "l 3"]
    mesh_cdf: Float64[np.ndarray, " s"]
    mesh_corners_world: Float32[np.ndarray, "f 3 3"]
    mesh_uv: Float32[np.ndarray, "f 3 2"]
    mesh_alpha: Float32[np.ndarray, "f 3"]
    texels_linear: Float32[np.ndarray, "x 3"]
    texture_sizes: Int64[np.ndarray, "k 6"]
    environment_linear: Float32[np.ndarray, "h w 3"]
    environment_row_cdf: Float64[np.ndarray, " h1"]
    environment_column_cdf: Float64[np.ndarray, "h w1"]
    environment_probabilities: Float64[np.ndarray, "h w"]
    environment_frame: Float64[np.ndarray, "3 3"]

    @property
    def environment_id(self) -> int:
        """Return the environment's place among the lights, -1 without one."""
        count = len(self.kinds)
        return count - 1 if count and self.kinds[-1] == ENVIRONMENT else -1


class MeshScene(NamedTuple):
    """The meshes of a stage, what they are made of, and the lights.

    Attributes:
        surfaces: the triangles.
        materials: theirs.
        lights: all lights.
        environment: number of the light that is the environment, -1 without one.
        any_nested: whether there is glass with a priority.
    """

    surfaces: SurfaceArrays
    materials: MaterialArrays
    lights: LightArrays
    environment: int
    any_nested: bool


class LayerArrays(NamedTuple):
    """Gaussians along ``n`` rays: arrays of a :class:`octasplat.engine.trace.protocol.TraceResult`.

    A ray of which less than ``min_transmittance`` is left ends in them.
    """

    rgb: Float32[np.ndarray, "n 3"]
    transmittance: Float32[np.ndarray, " n"]
    depth_median: Float32[np.ndarray, " n"]
    depth_sum: Float32[np.ndarray, " n"]
    normals: Float32[np.ndarray, "n 3"]
    features: Float32[np.ndarray, "n f"]
    min_transmittance: float


class Bsdf(NamedTuple):
    """The mixture of dielectric and metal at a point, and the clear coat over it.

    Attributes:
        rgb: linear base color.
        metallic: share of the metal.
        roughness: perceptual.
        ior: index of refraction of the dielectric.
        substrate: how the ground shares light with the coat.
        energy_compensation: whether light that facets throw at each other is kept.
        clear_coat: share of the surface under the clear coat.
        clear_coat_roughness: perceptual.
    """

    rgb: Rgb
    metallic: float
    roughness: float
    ior: float
    substrate: int
    energy_compensation: bool
    clear_coat: float
    clear_coat_roughness: float


class SurfacePoint(NamedTuple):
    """A point of a surface, its normal on the viewer's side, and the one that it is shaded by.

    Rays that go on begin ``ray_step`` off the surface; it is 0 where the point is off it already.
    """

    position: Vec3
    normal: Vec3
    shading_normal: Vec3
    ray_step: float


class AlbedoTables(NamedTuple):
    """Directional albedo of one bounce, by roughness and cosine.

    Attributes:
        ggx_albedo: of a colorless metal.
        coat_albedo: of the dielectric's surface.
        coat_mean_albedo: the cosine-weighted mean of ``coat_albedo`` over all directions.
        clear_coat_albedo: of the clear coat's surface.
    """

    ggx_albedo: Float64[np.ndarray, "a c"]
    coat_albedo: Float64[np.ndarray, "a c"]
    coat_mean_albedo: Float64[np.ndarray, "a 2"]
    clear_coat_albedo: Float64[np.ndarray, "a c"]


class MeshQueries(NamedTuple):
    """Embree queries on the meshes of a stage.

    Attributes:
        closest_hit: the nearest of all triangles.
        any_hit: whether there is any triangle that has no holes, see :mod:`.cutouts`.
        any_hit_opaque: whether there is any that has no holes and is not of glass.
        closest_hit_filter: the nearest of those that let light pass; its scene is 0 where there are none.
        filter_faces: rows in the surfaces of the faces that let light pass.
        any_cutout: whether some have holes.
    """

    closest_hit: EmbreeQuery
    any_hit: EmbreeQuery
    any_hit_opaque: EmbreeQuery
    closest_hit_filter: EmbreeQuery
    filter_faces: Int64[np.ndarray, " g"]
    any_cutout: bool


class IntegratorParameters(NamedTuple):
    """The numbers of an integrator that the kernels read.

    See :class:`octasplat.engine.pathtracing.stage.model.Integrator`.
    """

    seed: int
    max_depth: int
    roulette_depth: int
    clamp: float
    anti_aliasing: bool
    environment_visible: bool
    background_linear: Float64[np.ndarray, "3"]
