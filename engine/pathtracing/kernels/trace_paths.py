"""Paths among meshes alone, from the camera to their ends, a block that stays in the cache at a time."""

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.box_tests import end_paths_in_boxes, mark_shadows_in_boxes
from octasplat.engine.pathtracing.kernels.camera_paths import start_paths
from octasplat.engine.pathtracing.kernels.cutouts import pass_surfaces
from octasplat.engine.pathtracing.kernels.film import FilmArrays, add_paths
from octasplat.engine.pathtracing.kernels.kernel_args import IntegratorParameters, MeshQueries, MeshScene
from octasplat.engine.pathtracing.kernels.path_args import (
    Bounce,
    GaussianBoxes,
    PathBlock,
    PathScratch,
    PathStart,
)
from octasplat.engine.pathtracing.kernels.path_radiance import add_direct_light
from octasplat.engine.pathtracing.kernels.path_surfaces import shade_surfaces
from octasplat.engine.pathtracing.kernels.shadow_rays import shadow_transmittance
from octasplat.engine.trace.kernels.triangles import TriangleHitArrays, TriangleRays, closest_hits


@kernel(_nrt=False, error_model="numpy")
def trace_paths(
    count: int,
    scratch: PathScratch,
    integrator: IntegratorParameters,
    start: PathStart,
    scene: MeshScene,
    queries: MeshQueries,
    t_min: Float32[np.ndarray, "1"],
    t_max: Float32[np.ndarray, "1"],
    block: PathBlock,
    boxes: GaussianBoxes,
    film: FilmArrays,
    without_meshes: FilmArrays,
    enters_box: Bool[np.ndarray, " i"],
) -> None:
    """Start and end the paths of ``count`` pixels, and add them to a film.

    The camera sees nothing nearer than ``t_min``; ``t_max`` is infinite. A block has room for all paths that
    a pixel starts at a time. ``enters_box``, all False before, tells of which pixels a path may meet
    Gaussians: nothing is added to those.
    """
    paths, active, hits, shadows, transmittance = block
    each = start.paths_per_pixel
    together = len(active) // each
    for begin in range(0, count, together):
        pixels = min(together, count - begin)
        left = pixels * each
        first = start.first_pixel + begin
        part = PathStart(start.camera_rays, start.pixel_order, first, each, start.first_sample)
        start_paths(0, left, scratch, integrator, part, paths)
        enters = enters_box[begin : begin + pixels]
        for k in range(left):
            active[k] = k
        for depth in range(integrator.max_depth + 1):
            # --- what the rays meet ---
            # only the camera has a near limit
            scratch.t_starts[0] = t_min[0] if depth == 0 else np.float32(0.0)
            rays = TriangleRays(
                paths.origins_world, paths.directions_world, scratch.t_starts[:1], t_max, active
            )
            met = TriangleHitArrays(hits.distances, hits.faces, hits.barycentrics)
            # neighbors have about one direction at the camera only
            closest_hits(queries.closest_hit, rays, 0, left, depth == 0, scratch.embree, met)
            bounce = Bounce(paths, active, depth, hits, scene, integrator, shadows)
            if queries.any_cutout or scene.any_nested:
                pass_surfaces(0, left, scratch, queries, bounce)
            any_enters = False
            if boxes.all.shape[1] > 0:
                any_enters = end_paths_in_boxes(boxes.all, bounce, left, each, scratch.rows, enters)
            # --- surfaces, and light that reaches them ---
            shade_surfaces(0, left, scratch, bounce)
            if boxes.casting_shadows.shape[1] > 0 and mark_shadows_in_boxes(
                boxes.casting_shadows, bounce, left, each, scratch.rows, enters
            ):
                any_enters = True
            shadow_transmittance(
                0, left, scratch, queries, scene.surfaces, scene.materials, shadows, False, transmittance
            )
            add_direct_light(0, left, scratch, paths, active, shadows.radiance_linear, transmittance)
            # --- the paths that go on ---
            going = 0
            for k in range(left):
                # no branch: which path ends is not to be foreseen
                active[np.uintp(going)] = active[np.uintp(k)]
                going += paths.is_alive[np.uintp(active[np.uintp(k)])]
            if any_enters:
                left, going = going, 0
                for k in range(left):
                    active[going] = active[k]
                    going += not enters[active[k] // each]
            left = going
            if left == 0:
                break
        add_paths(pixels, paths, each, start.pixel_order, first, film, without_meshes, enters)
