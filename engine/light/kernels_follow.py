"""Paths among meshes alone, from the camera to their ends, a block that stays in the cache at a time."""

import numpy as np

from octasplat.engine.compilation import kernel
from octasplat.engine.light.arrays import BLOCK
from octasplat.engine.light.kernels_path import add_lit, meet_surfaces, start_paths
from octasplat.engine.light.kernels_shadows import let_through
from octasplat.engine.trace.kernels_triangles import closest_hits


@kernel(_nrt=False, error_model="numpy")
def follow_paths(
    count, scratch, view, rules, first_pixel, per_pixel, first_sample, order, near, no_end, paths, active,
    distances, faces, barycentrics, queries, surfaces, materials, lights, environment, shadows, share,
):  # fmt: skip
    """Start and end ``count`` paths of pixels ``order[first_pixel]`` and on; see :func:`start_paths`.

    ``active``, the hits, ``shadows`` and ``share`` are room for one block. The camera sees nothing nearer
    than ``near``; ``no_end`` is infinite.
    """
    for begin in range(0, count, BLOCK):
        end = min(begin + BLOCK, count)
        start_paths(
            begin, end, scratch, view, rules, first_pixel, per_pixel, first_sample, order, paths
        )  # fmt: skip
        left = end - begin
        for k in range(left):
            active[k] = begin + k
        for depth in range(rules.max_depth + 1):
            scratch.starts[0] = near[0] if depth == 0 else np.float32(0.0)
            closest_hits(
                queries.closest, paths.origins_world, paths.directions_world, scratch.starts[:1], no_end,
                active, 0, left, depth == 0, scratch.embree, distances, faces, barycentrics,
            )  # fmt: skip
            meet_surfaces(
                0, left, scratch, paths, active, depth, distances, faces, barycentrics, surfaces, materials,
                lights, environment, rules, shadows,
            )  # fmt: skip
            let_through(0, left, scratch, queries, surfaces, materials, shadows, False, share)
            add_lit(0, left, scratch, paths, active, shadows.lit, share)
            going = 0
            for k in range(left):
                if paths.alive[active[k]]:
                    active[going] = active[k]
                    going += 1
            left = going
            if left == 0:
                break
