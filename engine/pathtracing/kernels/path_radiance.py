"""Light that paths gather: what lies behind everything, shining surfaces, and what shadow rays bring."""

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.environment_light import environment_pdf, eval_environment
from octasplat.engine.pathtracing.kernels.kernel_args import IntegratorParameters, LightArrays
from octasplat.engine.pathtracing.kernels.lights import (
    emitter_hit_pdf,
    eval_emission,
    light_probability,
)
from octasplat.engine.pathtracing.kernels.path_args import PathArrays, PathScratch
from octasplat.engine.pathtracing.kernels.scatter import (
    FLAG_CAMERA_RAY,
    FLAG_SCATTERED,
    FLAG_THROUGH_GLASS,
)
from octasplat.engine.trace.kernels.native import njit_no_refcount


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_background(
    lights: LightArrays,
    environment: int,
    integrator: IntegratorParameters,
    flags: int,
    d_x: float,
    d_y: float,
    d_z: float,
) -> tuple[float, float, float]:
    """Return linear radiance from behind everything; ``environment`` is the number of that light or -1."""
    if environment >= 0 and (integrator.environment_visible or not flags & FLAG_CAMERA_RAY):
        return eval_environment(lights, d_x, d_y, d_z)
    background = integrator.background_linear
    return background[0], background[1], background[2]


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def add_radiance(paths: PathArrays, p: int, red: float, green: float, blue: float, clamp: float) -> None:
    """Add light to a path, no more than ``clamp`` of it where it comes by way of scattering."""
    if paths.flags[p] & FLAG_SCATTERED:
        most = max(red, green, blue)
        if most > clamp:
            # all channels alike: the color stays
            red, green, blue = red * clamp / most, green * clamp / most, blue * clamp / most
    paths.radiance_linear[p, 0] += red
    paths.radiance_linear[p, 1] += green
    paths.radiance_linear[p, 2] += blue


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def shade_miss(
    paths: PathArrays, p: int, lights: LightArrays, environment: int, integrator: IntegratorParameters
) -> None:
    """Terminate a path that leaves the scene, with the light of the background."""
    d = paths.directions_world[p]
    red, green, blue = eval_background(lights, environment, integrator, paths.flags[p], d[0], d[1], d[2])
    share = 1.0
    if environment >= 0 and paths.pdf[p] > 0.0:
        if not lights.is_hittable[environment]:
            return
        # the environment could also have been found by a light query: the balance heuristic's share
        o = paths.origins_world[p]
        pdf = light_probability(lights, environment, o[0], o[1], o[2]) * environment_pdf(
            lights, d[0], d[1], d[2]
        )
        share = paths.pdf[p] / (paths.pdf[p] + pdf)
    # an environment that the camera does not see leaves the background open
    if paths.flags[p] & FLAG_CAMERA_RAY and not (environment >= 0 and integrator.environment_visible):
        paths.coverage[p] = 1.0 - paths.transmittance[p]
    w = paths.throughput[p]
    add_radiance(paths, p, share * w[0] * red, share * w[1] * green, share * w[2] * blue, integrator.clamp)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def shade_emitter(
    paths: PathArrays,
    p: int,
    lights: LightArrays,
    l: int,
    distance: float,
    cosine: float,
    u: float,
    v: float,
    integrator: IntegratorParameters,
) -> None:
    """Add the light of a shining surface; ``cosine`` is that to its front, (u, v) the place on a mesh."""
    if cosine <= 0.0:
        return
    # of a lamp that does not light meshes, or that nothing shadows, this is no way to find light on them
    if paths.flags[p] & FLAG_SCATTERED and not lights.lights_meshes[l]:
        return
    if paths.pdf[p] > 0.0 and not lights.is_hittable[l]:
        return
    # glass was no obstacle to the light query
    if paths.flags[p] & FLAG_THROUGH_GLASS and not lights.casts_shadows[l]:
        return
    share = 1.0
    if paths.pdf[p] > 0.0:  # the camera, mirrors and glass find lights in no other way
        o = paths.origins_world[p]
        pdf = light_probability(lights, l, o[0], o[1], o[2]) * emitter_hit_pdf(lights, l, o, distance, cosine)
        share = paths.pdf[p] / (paths.pdf[p] + pdf)
    w = paths.throughput[p]
    red, green, blue = eval_emission(lights, l, u, v)
    add_radiance(paths, p, share * w[0] * red, share * w[1] * green, share * w[2] * blue, integrator.clamp)


@kernel(_nrt=False, error_model="numpy", fastmath={"contract"})
def add_direct_light(
    first: int,
    last: int,
    scratch: PathScratch,
    paths: PathArrays,
    active: Int32[np.ndarray, " n"],
    radiance: Float32[np.ndarray, "n 3"],
    transmittance: Float32[np.ndarray, "n 3"],
) -> None:
    """Add what shadow rays brought: ``radiance`` times the share of it that got through."""
    for row in range(first, last):
        k = np.uintp(row)  # unsigned: no place is counted from the end of an array
        if transmittance[k, 0] + transmittance[k, 1] + transmittance[k, 2] > 0.0:
            for channel in range(3):
                paths.radiance_linear[np.uintp(active[k]), channel] += (
                    radiance[k, channel] * transmittance[k, channel]
                )
