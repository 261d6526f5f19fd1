"""Paths among meshes alone, from the camera to their ends, a block that stays in the cache at a time."""

import numpy as np

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import BLOCK_SIZE
from octasplat.engine.pathtracing.kernels.path_surfaces import add_direct_light, shade_surfaces, start_paths
from octasplat.engine.pathtracing.kernels.shadow_rays import shadow_transmittance
from octasplat.engine.trace.kernels.triangles import closest_hits


@kernel(_nrt=False, error_model="numpy")
def trace_paths(
    count, scratch, camera_rays, integrator, first_pixel, paths_per_pixel, first_sample, pixel_order, t_min, t_max, paths, active,
    distances, faces, barycentrics, queries, surfaces, materials, lights, environment, shadows, transmittance,
):  # fmt: skip
    """Start and end ``count`` paths of pixels ``pixel_order[first_pixel]`` and on; see :func:`start_paths`.

    ``active``, the hits, ``shadows`` and ``transmittance`` are room for one block. The camera sees nothing nearer
    than ``t_min``; ``t_max`` is infinite.
    """
    for begin in range(0, count, BLOCK_SIZE):
        end = min(begin + BLOCK_SIZE, count)
        start_paths(
            begin, end, scratch, camera_rays, integrator, first_pixel, paths_per_pixel, first_sample, pixel_order, paths
        )  # fmt: skip
        left = end - begin
        for k in range(left):
            active[k] = begin + k
        for depth in range(integrator.max_depth + 1):
            scratch.t_starts[0] = t_min[0] if depth == 0 else np.float32(0.0)
            closest_hits(
                queries.closest_hit, paths.origins_world, paths.directions_world, scratch.t_starts[:1], t_max,
                active, 0, left, depth == 0, scratch.embree, distances, faces, barycentrics,
            )  # fmt: skip
            shade_surfaces(
                0, left, scratch, paths, active, depth, distances, faces, barycentrics, surfaces, materials,
                lights, environment, integrator, shadows,
            )  # fmt: skip
            shadow_transmittance(
                0, left, scratch, queries, surfaces, materials, shadows, False, transmittance
            )
            add_direct_light(0, left, scratch, paths, active, shadows.radiance_linear, transmittance)
            going = 0
            for k in range(left):
                if paths.is_alive[active[k]]:
                    active[going] = active[k]
                    going += 1
            left = going
            if left == 0:
                break
