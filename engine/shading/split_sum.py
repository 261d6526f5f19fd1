"""Split-sum shading: light of an environment off a surface of a material, as pure functions with gradients.

    color = (F0 A(N.V, r) + B(N.V, r)) (V L(R, r) + indirect) + (1 - m) albedo (ambient E(N) + bounced)

in linear light, with F0 = 0.04 (1 - m) + m albedo; L are the prefiltered levels of the environment in the
reflected direction R, E its irradiance over pi, and A, B a table that is integrated here. After "Real Shading
in Unreal Engine 4" (Karis 2013, https://blog.selfshadow.com/publications/s2013-shading-course/) and
"Reflective Gaussian Splatting" (https://arxiv.org/abs/2412.19282), whose diffuse part is another.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.shading.kernels.environment_levels import EnvironmentLevels
from octasplat.engine.shading.kernels.split_sum import (
    TAPS,
    ShadeBackward,
    ShadeGradients,
    SurfaceArrays,
    backward_pixels,
    integrate_table,
    shade_pixels,
)

TABLE_ROUGHNESSES = 32
TABLE_COSINES = 64
TABLE_SAMPLES = 512


@lru_cache(maxsize=1)
def split_sum_table() -> Float64[np.ndarray, "a c 2"]:
    """Return scale A and bias B of F0: rows are roughness 0 to 1, columns the cosine to the viewer 0 to 1."""
    table = np.empty((TABLE_ROUGHNESSES, TABLE_COSINES, 2))
    run_ranges(
        integrate_table,
        threads_in_use(),
        TABLE_ROUGHNESSES * TABLE_COSINES,
        TABLE_SAMPLES,
        table,
        grain=TABLE_COSINES,
    )
    return table


@dataclass(frozen=True)
class SurfacePoints:
    """Inputs of the shading of ``p`` points.

    Attributes:
        material: albedo (linear), metallic, perceptual roughness.
        normal_world: unit normals, turned to the viewer.
        direction_world: unit directions from the viewer to the points.
        visibility: share of the environment that is seen along the reflected direction.
        indirect_linear: light that comes from there instead, already times one minus that.
        ambient: share of the irradiance that arrives.
        bounced_linear: irradiance over pi that comes from other surfaces.
    """

    material: Float64[np.ndarray, "p 5"]
    normal_world: Float64[np.ndarray, "p 3"]
    direction_world: Float64[np.ndarray, "p 3"]
    visibility: Float64[np.ndarray, " p"]
    indirect_linear: Float64[np.ndarray, "p 3"]
    ambient: Float64[np.ndarray, " p"]
    bounced_linear: Float64[np.ndarray, "p 3"]

    @classmethod
    def unoccluded(
        cls,
        material: Float[np.ndarray, "p 5"],
        normal_world: Float[np.ndarray, "p 3"],
        direction_world: Float[np.ndarray, "p 3"],
    ) -> "SurfacePoints":
        """Return surface points that nothing hides from the environment."""
        count = len(material)
        nothing = np.zeros((count, 3))
        return cls(
            material.astype(np.float64),
            normal_world.astype(np.float64),
            direction_world.astype(np.float64),
            visibility=np.ones(count),
            indirect_linear=nothing,
            ambient=np.ones(count),
            bounced_linear=nothing,
        )


def shade(
    surface: SurfacePoints, light: EnvironmentLevels, frame: Float64[np.ndarray, "3 3"]
) -> Float64[np.ndarray, "p 3"]:
    """Return linear colors.

    Args:
        surface: the points.
        light: the environment's levels.
        frame: its right, up and forward in the world, as rows.
    """
    rgb = np.empty((len(surface.material), 3))
    run_ranges(
        shade_pixels, threads_in_use(), len(rgb),
        _surface_arrays(surface, frame), light, split_sum_table(), rgb,
    )  # fmt: skip
    return rgb


def shade_backward(
    surface: SurfacePoints,
    light: EnvironmentLevels,
    frame: Float64[np.ndarray, "3 3"],
    grad_rgb: Float64[np.ndarray, "p 3"],
    *,
    blur: float = 0.0,
) -> ShadeGradients:
    """Return the gradients of :func:`shade` by its inputs.

    Args:
        surface: the points.
        light: the environment's levels.
        frame: its right, up and forward in the world, as rows.
        grad_rgb: gradient by the colors.
        blur: roughness from which on up the levels may lead the reflected direction: one that sees far,
            while normals are still wrong. 0 gives the true gradient.
    """
    count = len(surface.material)
    widths = {"material": 5, "taps": TAPS, "weights": TAPS, "visibility": 0, "ambient": 0}
    arrays = {
        name: np.empty(
            (count, widths.get(name, 3)) if widths.get(name, 3) else count,
            np.int32 if name == "taps" else np.float64,
        )
        for name in ShadeGradients._fields
    }
    out = ShadeGradients(**arrays)
    run_ranges(
        backward_pixels,
        threads_in_use(),
        count,
        ShadeBackward(_surface_arrays(surface, frame), light, split_sum_table(), blur, grad_rgb, out),
    )
    # back from the map's frame to the world
    return out._replace(normal=out.normal @ frame, reflected=out.reflected @ frame)


def _surface_arrays(surface: SurfacePoints, frame: Float64[np.ndarray, "3 3"]) -> SurfaceArrays:
    return SurfaceArrays(
        material=surface.material,
        normal=np.ascontiguousarray(surface.normal_world @ frame.T),
        direction=np.ascontiguousarray(surface.direction_world @ frame.T),
        visibility=surface.visibility,
        indirect=surface.indirect_linear,
        ambient=surface.ambient,
        bounced=surface.bounced_linear,
    )
