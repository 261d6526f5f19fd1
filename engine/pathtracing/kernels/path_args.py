"""Arguments of the path tracer's kernels that describe paths: named tuples of arrays."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt32

from octasplat.engine.pathtracing.kernels.kernel_args import IntegratorParameters, LightArrays, MeshScene
from octasplat.engine.pathtracing.kernels.scatter_vectors import LAMP_SAMPLE_ROWS, WAY_ROWS
from octasplat.engine.pathtracing.kernels.surface_point_vectors import SURFACE_POINT_ROWS
from octasplat.engine.trace.cpu.kernels.simd_vector import LANES
from octasplat.engine.trace.triangle_bvh import allocate_embree_scratch

BLOCK_SIZE = 1024
"""Rows that a thread works on at a time: few enough for the nearest cache."""
CAMERA_SAMPLE_PAIRS = 2
"""Pairs of uniform numbers that a path uses at the camera: one for the pixel, one for the lens."""
SHADING_ROWS = 64
"""Rows whose points of surfaces a thread works out at a time, before it shades them."""
LAMP_ROW = SURFACE_POINT_ROWS
WAY_ROW = LAMP_ROW + LAMP_SAMPLE_ROWS
"""Rows behind those of points of surfaces: samples of the only lamp, ways on from diffuse surfaces."""
SAMPLE_PAIRS_PER_BOUNCE = 5
"""Pairs of uniform numbers that a path uses at each surface."""
MAX_NESTED = 4
"""Meshes of glass in each other of which a path keeps account."""
PATH_ENDED = -2
"""In place of a face: the ray ended in front of what it would have met."""


class PathArrays(NamedTuple):
    """``p`` paths from the camera: what they have gathered, and where they go on.

    Attributes:
        keys: what a pixel's numbers begin from.
        samples: number of the path in its pixel.
        origins_world: where the next ray begins.
        directions_world: where it goes, unit vectors.
        throughput: what light that it brings still counts, per channel.
        radiance_linear: light of the surfaces and surroundings behind the first layer.
        layer_srgb: display colors of the Gaussians of the first layer, premultiplied.
        transmittance: what the first layer lets through.
        shading_factor: sum over the first layer of coverage times the factor that the stage's lights give
            to it.
        coverage: 1 less what is seen of the background behind everything.
        mesh_visibility: what the Gaussians let through of the first mesh that the camera's ray meets; 0
            without one.
        albedo_linear: color of that mesh, white where it mirrors or lets through, times the same share.
        normals_world: its shading normal times the same share.
        pdf: of the last direction over solid angle; 0 for the camera, mirrors and glass.
        t_view_origin: where on the next ray its viewer stands, see
            :class:`octasplat.engine.core.rays.RayBatch`.
        medium_ids: material that the path is in, -1 for air.
        media: glass with a priority that it is inside, in the order of entering, -1 for none.
        flags: bits of :mod:`octasplat.engine.pathtracing.kernels.scatter`.
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
    media: Int32[np.ndarray, "p d"]
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
        media: glass with a priority that the points are inside.
        medium_ids: material that the points are in, -1 for air.
    """

    origins_world: Float32[np.ndarray, "n 3"]
    directions_world: Float32[np.ndarray, "n 3"]
    t_max: Float32[np.ndarray, " n"]
    radiance_linear: Float32[np.ndarray, "n 3"]
    occluded_radiance_linear: Float32[np.ndarray, "n 3"]
    passes_glass: Bool[np.ndarray, " n"]
    media: Int32[np.ndarray, "n d"]
    medium_ids: Int32[np.ndarray, " n"]


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


class MeshHits(NamedTuple):
    """Nearest hits of ``n`` rays with the meshes.

    Attributes:
        distances: infinite where a ray meets nothing.
        faces: -1 where a ray meets nothing.
        barycentrics: weights of the second and third corner.
        media: glass with a priority that the rays are inside when they arrive; no rows where there is none.
    """

    distances: Float32[np.ndarray, " n"]
    faces: Int32[np.ndarray, " n"]
    barycentrics: Float32[np.ndarray, "n 2"]
    media: Int32[np.ndarray, "m d"]


class PathSamples(NamedTuple):
    """Uniform numbers of one path at a surface: column ``n`` of pairs."""

    random_numbers: Float64[np.ndarray, "d 2 b"]
    n: int


class LightQuery(NamedTuple):
    """Light query of a surface: row ``k`` of the shadow rays."""

    lights: LightArrays
    integrator: IntegratorParameters
    shadows: ShadowRayArrays
    k: int


class Bounce(NamedTuple):
    """The next surfaces of paths.

    Attributes:
        paths: all paths.
        active: those that go on.
        depth: surfaces that they have met before.
        hits: what the rays of ``active`` meet first of the meshes.
        scene: what they may meet.
        integrator: how they go on.
        shadows: a row for each of ``active``, for what it asks of lights.
    """

    paths: PathArrays
    active: Int32[np.ndarray, " n"]
    depth: int
    hits: MeshHits
    scene: MeshScene
    integrator: IntegratorParameters
    shadows: ShadowRayArrays


class PathScratch(NamedTuple):
    """Scratch memory of one thread's kernels, for ``b`` rows at a time.

    Attributes:
        embree: see :func:`octasplat.engine.trace.triangle_bvh.allocate_embree_scratch`.
        keys: of paths.
        samples: of paths.
        random_numbers: pairs of uniform numbers.
        rows: those of a block that something is done for.
        origins: of their rays.
        directions: likewise.
        t_starts: where they begin on their rays.
        t_ends: where they end.
        is_occluded: whether something is in their way.
        distances: of what they met.
        faces: likewise.
        barycentrics: likewise.
        surface_points: of some of the rows, see :mod:`.surface_point_vectors` and :mod:`.scatter_vectors`.
    """

    embree: Float32[np.ndarray, " w"]
    keys: UInt32[np.ndarray, " b"]
    samples: Int32[np.ndarray, " b"]
    random_numbers: Float64[np.ndarray, "d 2 b"]
    rows: Int32[np.ndarray, " b"]
    origins: Float32[np.ndarray, "b 3"]
    directions: Float32[np.ndarray, "b 3"]
    t_starts: Float32[np.ndarray, " b"]
    t_ends: Float32[np.ndarray, " b"]
    is_occluded: Bool[np.ndarray, " b"]
    distances: Float32[np.ndarray, " b"]
    faces: Int32[np.ndarray, " b"]
    barycentrics: Float32[np.ndarray, "b 2"]
    surface_points: Float64[np.ndarray, "23 s"]


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


class GaussianBoxes(NamedTuple):
    """Boxes around Gaussians, a column each: least corner, greatest corner; none without Gaussians.

    Attributes:
        all: around all of them.
        casting_shadows: around those that cast shadows on meshes.
    """

    all: Float32[np.ndarray, "6 b"]
    casting_shadows: Float32[np.ndarray, "6 c"]


class PathBlock(NamedTuple):
    """Memory in which one thread follows a block of paths.

    Attributes:
        paths: the paths.
        active: which of them are left.
        hits: what they meet.
        shadows: what they ask of lights.
        transmittance: what meshes let through of it.
    """

    paths: PathArrays
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
        np.empty(count, np.int32), allocate_media(count), np.empty(count, np.int32),
        np.empty(count, np.bool_),
    )  # fmt: skip


def allocate_media(count: int) -> Int32[np.ndarray, "n d"]:
    """Return lists of glass with nothing in them."""
    return np.full((count, MAX_NESTED), -1, np.int32)


def allocate_shadow_rays(count: int) -> ShadowRayArrays:
    """Allocate shadow rays without radiance."""
    return ShadowRayArrays(
        np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32), np.zeros(count, np.float32),
        np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32), np.zeros(count, np.bool_),
        allocate_media(count), np.full(count, -1, np.int32),
    )  # fmt: skip


def allocate_path_scratch(threads: int) -> list[PathScratch]:
    """Return memory for the kernels of so many threads."""
    return [
        PathScratch(
            allocate_embree_scratch(1)[0], np.empty(BLOCK_SIZE, np.uint32), np.empty(BLOCK_SIZE, np.int32),
            # rows of a power of two would share one set of the cache
            np.empty((SAMPLE_PAIRS_PER_BOUNCE - 1, 2, BLOCK_SIZE + LANES)),
            np.empty(BLOCK_SIZE + LANES, np.int32),  # the last ones may be repeated to fill a vector
            np.empty((BLOCK_SIZE, 3), np.float32), np.empty((BLOCK_SIZE, 3), np.float32),
            np.empty(BLOCK_SIZE, np.float32), np.empty(BLOCK_SIZE, np.float32),
            np.empty(BLOCK_SIZE, np.bool_),
            np.empty(BLOCK_SIZE, np.float32), np.empty(BLOCK_SIZE, np.int32),
            np.empty((BLOCK_SIZE, 2), np.float32), np.empty((WAY_ROW + WAY_ROWS, SHADING_ROWS)),
        )
        for _ in range(threads)
    ]  # fmt: skip
