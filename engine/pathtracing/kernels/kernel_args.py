"""Arguments of the path tracer's kernels: named tuples of arrays."""

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt32

from octasplat.engine.trace.kernels.triangles import EmbreeQuery
from octasplat.engine.trace.triangle_bvh import allocate_embree_scratch

BLOCK_SIZE = 1024
"""Rows that a thread works on at a time: few enough for the nearest cache."""
Vec3: TypeAlias = tuple[float, float, float]
"""A point or a direction."""
Rgb: TypeAlias = tuple[float, float, float]
"""Linear red, green and blue."""
POINT, SPOT, DIRECTIONAL, RECTANGLE, ENVIRONMENT, SPHERE, MESH = 0, 1, 2, 3, 4, 5, 6
"""Kinds of lights."""
SAMPLE_PAIRS_PER_BOUNCE = 5
"""Pairs of uniform numbers that a path uses at each surface."""


class SurfaceArrays(NamedTuple):
    """All triangles of a stage.

    Attributes:
        corners_world: of each face.
        corner_normals: shading normals at the corners, unit vectors.
        corner_uv: texture coordinates at the corners, (0, 0) at the upper left.
        material_ids: row of each face in :class:`MaterialArrays`.
        corner_rgb_linear: colours of the corners; no rows at all where no mesh has any.
    """

    corners_world: Float32[np.ndarray, "f 3 3"]
    corner_normals: Float32[np.ndarray, "f 3 3"]
    corner_uv: Float32[np.ndarray, "f 3 2"]
    material_ids: Int32[np.ndarray, " f"]
    corner_rgb_linear: Float32[np.ndarray, "g 3 3"]


class MaterialArrays(NamedTuple):
    """``m`` materials.

    Attributes:
        kinds: which of the kinds of :mod:`octasplat.engine.pathtracing.kernels.surface`.
        colours_linear: base colour, reflectance or tint.
        metallic: share of the metal.
        roughness: perceptual.
        iors: index of refraction.
        absorption: per world unit.
        substrates: how the ground shares light with the coat.
        energy_compensation: whether light that facets throw at each other is kept.
        coat_tables: which of the tables the coat has; of rough glass that of entering, leaving has the next.
        colour_textures: number of a texture, -1 for none.
        metallic_roughness_textures: likewise.
        normal_textures: likewise.
        normal_scales: factor of their slopes.
        uses_vertex_color: whether the corners' colours count.
        light_ids: number of the light that a shining surface is, -1 for none.
        ggx_albedo: table of facets that reflect everything.
        coat_albedo: tables of dielectrics' surfaces.
        coat_mean_albedo: their means.
        texels_linear: all textures' values, one texture after another.
        texture_sizes: first texel, height and width of each.
    """

    kinds: Int32[np.ndarray, " m"]
    colours_linear: Float64[np.ndarray, "m 3"]
    metallic: Float64[np.ndarray, " m"]
    roughness: Float64[np.ndarray, " m"]
    iors: Float64[np.ndarray, " m"]
    absorption: Float64[np.ndarray, "m 3"]
    substrates: Int32[np.ndarray, " m"]
    energy_compensation: Int32[np.ndarray, " m"]
    coat_tables: Int32[np.ndarray, " m"]
    colour_textures: Int32[np.ndarray, " m"]
    metallic_roughness_textures: Int32[np.ndarray, " m"]
    normal_textures: Int32[np.ndarray, " m"]
    normal_scales: Float64[np.ndarray, " m"]
    uses_vertex_color: Int32[np.ndarray, " m"]
    light_ids: Int32[np.ndarray, " m"]
    ggx_albedo: Float64[np.ndarray, "a c"]
    coat_albedo: Float64[np.ndarray, "t a c"]
    coat_mean_albedo: Float64[np.ndarray, "t a 2"]
    texels_linear: Float32[np.ndarray, "x 3"]
    texture_sizes: Int64[np.ndarray, "k 3"]


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
        any_adds_light: whether any is.
        textures: of meshes, -1 for none.
        mesh_rows: of meshes: first and last row of their sums, and first triangle.
        mesh_cdf: cumulative shares of the triangles' areas, from 0 to 1 for each mesh.
        mesh_corners_world: of the triangles of all meshes.
        mesh_uv: likewise.
        texels_linear: see :class:`MaterialArrays`, as the next one.
        texture_sizes: first texel, height and width of each.
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
    any_adds_light: bool
    textures: Int32[np.ndarray, " l"]
    mesh_rows: Int64[np.ndarray, "l 3"]
    mesh_cdf: Float64[np.ndarray, " s"]
    mesh_corners_world: Float32[np.ndarray, "f 3 3"]
    mesh_uv: Float32[np.ndarray, "f 3 2"]
    texels_linear: Float32[np.ndarray, "x 3"]
    texture_sizes: Int64[np.ndarray, "k 3"]
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


class PathArrays(NamedTuple):
    """``p`` paths from the camera: what they have gathered, and where they go on.

    Attributes:
        keys: what a pixel's numbers begin from.
        samples: number of the path in its pixel.
        origins_world: where the next ray begins.
        directions_world: where it goes, unit vectors.
        throughput: what light that it brings still counts, per channel.
        radiance_linear: light of the surfaces and surroundings behind the first layer.
        layer_srgb: display colours of the Gaussians of the first layer, premultiplied.
        transmittance: what the first layer lets through.
        shading_factor: sum over the first layer of coverage times the factor that the stage's lights give
            to it.
        coverage: 1 less what is seen of the background behind everything.
        mesh_visibility: what the Gaussians let through of the first mesh that the camera's ray meets; 0
            without one.
        albedo_linear: colour of that mesh, white where it mirrors or lets through, times the same share.
        normals_world: its shading normal times the same share.
        pdf: of the last direction over solid angle; 0 for the camera, mirrors and glass.
        t_view_origin: where on the next ray its viewer stands, see
            :class:`octasplat.engine.core.rays.RayBatch`.
        medium_ids: material that the path is in, -1 for air.
        flags: bits of :mod:`octasplat.engine.pathtracing.kernels.path_surfaces`.
        is_alive: whether the path goes on.
    """

    keys: UInt32[np.ndarray, " p"]
    samples: Int32[np.ndarray, " p"]
    origins_world: Float32[np.ndarray, "p 3"]
    directions_world: Float32[np.ndarray, "p 3"]
    throughput: Float32[np.ndarray, "p 3"]
    radiance_linear: Float32[np.ndarray, "p 3"]
    layer_srgb: Float32[np.ndarray, "p 3"]
    transmittance: Float32[np.ndarray, " p"]
    shading_factor: Float32[np.ndarray, "p 3"]
    coverage: Float32[np.ndarray, " p"]
    mesh_visibility: Float32[np.ndarray, " p"]
    albedo_linear: Float32[np.ndarray, "p 3"]
    normals_world: Float32[np.ndarray, "p 3"]
    pdf: Float32[np.ndarray, " p"]
    t_view_origin: Float32[np.ndarray, " p"]
    medium_ids: Int32[np.ndarray, " p"]
    flags: Int32[np.ndarray, " p"]
    is_alive: Bool[np.ndarray, " p"]


class ShadowRayArrays(NamedTuple):
    """Rays from ``n`` lit points to lights, and what they bring where nothing is in the way.

    Attributes:
        origins_world: the points.
        directions_world: unit vectors to the lights.
        t_max: up to where something may be in the way.
        radiance_linear: what is added where the way is free, times the transmittance of what is in it.
        occluded_radiance_linear: what is added (it is negative) where a mesh is in the way of light that
            would have come.
        passes_glass: whether glass in the way lets light straight through, as no path could find it
            otherwise.
    """

    origins_world: Float32[np.ndarray, "n 3"]
    directions_world: Float32[np.ndarray, "n 3"]
    t_max: Float32[np.ndarray, " n"]
    radiance_linear: Float32[np.ndarray, "n 3"]
    occluded_radiance_linear: Float32[np.ndarray, "n 3"]
    passes_glass: Bool[np.ndarray, " n"]


class SurfaceInteractions(NamedTuple):
    """``n`` points of surfaces, each seen along a ray.

    Attributes:
        points_world: from where rays go on, a little off the surface.
        normals_world: unit normals on the viewer's side.
        directions_world: unit vectors from the viewer.
        materials: linear albedo, metallic and perceptual roughness.
    """

    points_world: Float32[np.ndarray, "n 3"]
    normals_world: Float32[np.ndarray, "n 3"]
    directions_world: Float32[np.ndarray, "n 3"]
    materials: Float32[np.ndarray, "n 5"]


class MeshScene(NamedTuple):
    """The meshes of a stage, what they are made of, and the lights.

    Attributes:
        surfaces: the triangles.
        materials: theirs.
        lights: all lights.
        environment: number of the light that is the environment, -1 without one.
    """

    surfaces: SurfaceArrays
    materials: MaterialArrays
    lights: LightArrays
    environment: int


class MeshHits(NamedTuple):
    """Nearest hits of ``n`` rays with the meshes.

    Attributes:
        distances: infinite where a ray meets nothing.
        faces: -1 where a ray meets nothing.
        barycentrics: weights of the second and third corner.
    """

    distances: Float32[np.ndarray, " n"]
    faces: Int32[np.ndarray, " n"]
    barycentrics: Float32[np.ndarray, "n 2"]


class LayerArrays(NamedTuple):
    """Gaussians along ``n`` rays: arrays of a :class:`octasplat.engine.trace.protocol.TraceResult`."""

    rgb: Float32[np.ndarray, "n 3"]
    transmittance: Float32[np.ndarray, " n"]
    depth_median: Float32[np.ndarray, " n"]
    depth_sum: Float32[np.ndarray, " n"]
    normals: Float32[np.ndarray, "n 3"]
    features: Float32[np.ndarray, "n f"]


class Bsdf(NamedTuple):
    """The mixture of dielectric and metal at a point.

    Attributes:
        rgb: linear base color.
        metallic: share of the metal.
        roughness: perceptual.
        ior: index of refraction of the dielectric.
        substrate: how the ground shares light with the coat.
        energy_compensation: whether light that facets throw at each other is kept.
    """

    rgb: Rgb
    metallic: float
    roughness: float
    ior: float
    substrate: int
    energy_compensation: bool


class AlbedoTables(NamedTuple):
    """Directional albedo of one bounce, by roughness and cosine.

    Attributes:
        ggx_albedo: of a colorless metal.
        coat_albedo: of the dielectric's surface.
        coat_mean_albedo: the cosine-weighted mean of ``coat_albedo`` over all directions.
    """

    ggx_albedo: Float64[np.ndarray, "a c"]
    coat_albedo: Float64[np.ndarray, "a c"]
    coat_mean_albedo: Float64[np.ndarray, "a 2"]


class PathSamples(NamedTuple):
    """Uniform numbers of one path at a surface: column ``n`` of pairs."""

    random_numbers: Float64[np.ndarray, "d 2 b"]
    n: int


class MeshQueries(NamedTuple):
    """Embree queries on the meshes of a stage.

    Attributes:
        closest_hit: the nearest of all triangles.
        any_hit: whether there is any triangle.
        any_hit_opaque: whether there is any that is not glass.
        closest_hit_glass: the nearest of glass; its scene is 0 where there is no glass.
        glass_faces: rows in the surfaces of the faces of glass.
    """

    closest_hit: EmbreeQuery
    any_hit: EmbreeQuery
    any_hit_opaque: EmbreeQuery
    closest_hit_glass: EmbreeQuery
    glass_faces: Int64[np.ndarray, " g"]


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


class LightQuery(NamedTuple):
    """Light query of a surface: row ``k`` of the shadow rays."""

    lights: LightArrays
    integrator: IntegratorParameters
    shadows: ShadowRayArrays
    k: int


class PathScratch(NamedTuple):
    """Scratch memory of one thread's kernels, for ``b`` rows at a time.

    Attributes:
        embree: see :func:`octasplat.engine.trace.triangle_bvh.allocate_embree_scratch`.
        keys: of paths.
        samples: of paths.
        random_numbers: pairs of uniform numbers.
        rows: those of a block that something is done for.
        t_starts: where their rays begin.
        is_occluded: whether something is in their way.
        distances: of what they met.
        faces: likewise.
        barycentrics: likewise.
    """

    embree: Float32[np.ndarray, " w"]
    keys: UInt32[np.ndarray, " b"]
    samples: Int32[np.ndarray, " b"]
    random_numbers: Float64[np.ndarray, "d 2 b"]
    rows: Int32[np.ndarray, " b"]
    t_starts: Float32[np.ndarray, " b"]
    is_occluded: Bool[np.ndarray, " b"]
    distances: Float32[np.ndarray, " b"]
    faces: Int32[np.ndarray, " b"]
    barycentrics: Float32[np.ndarray, "b 2"]


class CameraRays(NamedTuple):
    """A camera's rays.

    Attributes:
        origin_world: where they begin.
        directions_world: unit vectors through the centres of the pixels.
        axis: the camera's axis.
        aperture: diameter of the lens.
        focus_distance: along the axis.
    """

    origin_world: Float64[np.ndarray, "3"]
    directions_world: Float32[np.ndarray, "h w 3"]
    axis: Float64[np.ndarray, "3"]
    aperture: float
    focus_distance: float


class PathStart(NamedTuple):
    """Range of paths to start: ``paths_per_pixel`` for each of ``pixel_order[first_pixel:]``.

    Their sample numbers begin with ``first_sample``.

    They are numbered from ``first_sample`` on.
    """

    camera_rays: CameraRays
    pixel_order: Int64[np.ndarray, " n"]
    first_pixel: int
    paths_per_pixel: int
    first_sample: int


class PathBlock(NamedTuple):
    """Memory in which one thread follows a block of paths.

    Attributes:
        active: which paths are left.
        hits: what they meet.
        shadows: what they ask of lights.
        transmittance: what meshes let through of it.
    """

    active: Int32[np.ndarray, " b"]
    hits: MeshHits
    shadows: ShadowRayArrays
    transmittance: Float32[np.ndarray, "b 3"]


def allocate_paths(count: int) -> PathArrays:
    """Allocate the arrays of paths, without values."""

    def vectors() -> Float32[np.ndarray, "p 3"]:
        return np.empty((count, 3), np.float32)

    return PathArrays(
        np.empty(count, np.uint32), np.empty(count, np.int32),
        vectors(), vectors(), vectors(), vectors(), vectors(),
        np.empty(count, np.float32), vectors(), np.empty(count, np.float32), np.empty(count, np.float32),
        vectors(), vectors(), np.empty(count, np.float32), np.empty(count, np.float32),
        np.empty(count, np.int32), np.empty(count, np.int32), np.empty(count, np.bool_),
    )  # fmt: skip


def allocate_shadow_rays(count: int) -> ShadowRayArrays:
    """Allocate shadow rays without radiance."""
    return ShadowRayArrays(
        np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32), np.zeros(count, np.float32),
        np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32), np.zeros(count, np.bool_),
    )  # fmt: skip


def allocate_path_scratch(threads: int) -> list[PathScratch]:
    """Return memory for the kernels of so many threads."""
    return [
        PathScratch(
            allocate_embree_scratch(1)[0], np.empty(BLOCK_SIZE, np.uint32), np.empty(BLOCK_SIZE, np.int32),
            np.empty((SAMPLE_PAIRS_PER_BOUNCE - 1, 2, BLOCK_SIZE)), np.empty(BLOCK_SIZE, np.int32),
            np.empty(BLOCK_SIZE, np.float32), np.empty(BLOCK_SIZE, np.bool_),
            np.empty(BLOCK_SIZE, np.float32), np.empty(BLOCK_SIZE, np.int32),
            np.empty((BLOCK_SIZE, 2), np.float32),
        )
        for _ in range(threads)
    ]  # fmt: skip
