"""Sums over the paths of each pixel."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.path_args import PathArrays
from octasplat.engine.pathtracing.kernels.scatter import FLAG_GAUSSIAN_SURFACE
from octasplat.engine.trace.kernels.native import njit_no_refcount


class FilmArrays(NamedTuple):
    """Sums over the paths of each of ``n`` pixels; see :class:`octasplat.engine.pathtracing.film.Film`.

    Attributes:
        layer_srgb: display colors of the first layer.
        light_linear: radiance behind it, times what it lets through.
        shading: factors of the stage's lights.
        albedo_linear: of the first mesh; no rows where the film keeps none.
        normals_world: likewise.
        front_linear: radiance of Gaussians with materials that the camera sees.
        transmittance: what the first layer lets through.
        coverage: 1 less what is seen of the background.
        mesh_visibility: what is seen of the first mesh.
        samples: number of paths.
        front: number of those that end at Gaussians with materials.
    """

    layer_srgb: Float64[np.ndarray, "n 3"]
    light_linear: Float64[np.ndarray, "n 3"]
    shading: Float64[np.ndarray, "n 3"]
    albedo_linear: Float64[np.ndarray, "g 3"]
    normals_world: Float64[np.ndarray, "g 3"]
    front_linear: Float64[np.ndarray, "n 3"]
    transmittance: Float64[np.ndarray, " n"]
    coverage: Float64[np.ndarray, " n"]
    mesh_visibility: Float64[np.ndarray, " n"]
    samples: Float64[np.ndarray, " n"]
    front: Float64[np.ndarray, " n"]


def allocate_film(pixels: int, *, has_guides: bool = False) -> FilmArrays:
    """Return empty sums; those that guide a denoiser only where they are asked for."""
    guides = pixels if has_guides else 0
    return FilmArrays(
        *(np.zeros((count, 3)) for count in (pixels, pixels, pixels, guides, guides, pixels)),
        *np.zeros((5, pixels)),
    )


@njit_no_refcount(forceinline=True)
def _add_pixel(
    paths: PathArrays, first: int, last: int, without_meshes: bool, film: FilmArrays, pixel: int
) -> None:
    """Add the paths ``first`` to ``last`` to a pixel, ``without_meshes`` only those that meet none."""
    through = coverage = visibility = counted = front = 0.0
    light_r = light_g = light_b = front_r = front_g = front_b = 0.0
    layer_r = layer_g = layer_b = shading_r = shading_g = shading_b = 0.0
    for k in range(first, last):
        if without_meshes and paths.mesh_visibility[k] != 0.0:
            continue
        counted += 1.0
        coverage += paths.coverage[k]
        visibility += paths.mesh_visibility[k]
        layer_r += paths.layer_srgb[k, 0]
        layer_g += paths.layer_srgb[k, 1]
        layer_b += paths.layer_srgb[k, 2]
        shading_r += paths.shading_factor[k, 0]
        shading_g += paths.shading_factor[k, 1]
        shading_b += paths.shading_factor[k, 2]
        red = float(paths.radiance_linear[k, 0])
        green = float(paths.radiance_linear[k, 1])
        blue = float(paths.radiance_linear[k, 2])
        # a path either ends at a surface of Gaussians or goes on behind the layer
        if paths.flags[k] & FLAG_GAUSSIAN_SURFACE != 0:
            front += 1.0
            front_r, front_g, front_b = front_r + red, front_g + green, front_b + blue
        else:
            share = float(paths.transmittance[k])
            through += share
            light_r, light_g, light_b = light_r + share * red, light_g + share * green, light_b + share * blue
    film.samples[pixel] += counted
    film.coverage[pixel] += coverage
    film.mesh_visibility[pixel] += visibility
    film.transmittance[pixel] += through
    film.front[pixel] += front
    film.layer_srgb[pixel, 0] += layer_r
    film.layer_srgb[pixel, 1] += layer_g
    film.layer_srgb[pixel, 2] += layer_b
    film.shading[pixel, 0] += shading_r
    film.shading[pixel, 1] += shading_g
    film.shading[pixel, 2] += shading_b
    film.light_linear[pixel, 0] += light_r
    film.light_linear[pixel, 1] += light_g
    film.light_linear[pixel, 2] += light_b
    film.front_linear[pixel, 0] += front_r
    film.front_linear[pixel, 1] += front_g
    film.front_linear[pixel, 2] += front_b


@njit_no_refcount(forceinline=True)
def _add_guides(paths: PathArrays, first: int, last: int, film: FilmArrays, pixel: int) -> None:
    """Add what guides a denoiser of the paths ``first`` to ``last`` to a pixel."""
    for channel in range(3):
        albedo = normal = 0.0
        for k in range(first, last):
            albedo += paths.albedo_linear[k, channel]
            normal += paths.normals_world[k, channel]
        film.albedo_linear[pixel, channel] += albedo
        film.normals_world[pixel, channel] += normal


@kernel(_nrt=False, error_model="numpy")
def add_paths(
    count: int,
    paths: PathArrays,
    paths_per_pixel: int,
    pixels: Int64[np.ndarray, " i"],
    first_pixel: int,
    film: FilmArrays,
    without_meshes: FilmArrays,
    is_left_out: Bool[np.ndarray, " i"],
) -> None:
    """Add ``paths_per_pixel`` paths to each of ``count`` of the ``pixels``, from the first one on.

    All is summed in float64, one after the other. ``without_meshes`` gets those that meet no mesh, unless it
    has no rows. Pixels that are left out get nothing.
    """
    for i in range(count):
        if is_left_out[i]:
            continue
        pixel, first, last = pixels[first_pixel + i], i * paths_per_pixel, (i + 1) * paths_per_pixel
        _add_pixel(paths, first, last, False, film, pixel)
        if len(film.albedo_linear) > 0:
            _add_guides(paths, first, last, film, pixel)
        if len(without_meshes.samples) > 0:
            _add_pixel(paths, first, last, True, without_meshes, pixel)
