"""Lights of a stage as arrays that the kernels read."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32

from engine.colour import srgb_to_linear
from engine.light.environment import EnvironmentMap, environment_sampler, irradiance_mean
from engine.light.kernels_lights import (
    DIRECTIONAL,
    ENVIRONMENT,
    POINT,
    RECTANGLE,
    SPOT,
    environment_values,
    light_samples,
)
from engine.light.stage import DirectionalLight, Light, PointLight, RectangleLight, SpotLight


class LightArrays(NamedTuple):
    """``l`` lights, the environment last among them where there is one.

    Attributes:
        kinds: which of the kinds of :mod:`engine.light.kernels_lights`.
        positions_world: of points and spots; centres of rectangles.
        axes: unit vectors: the way that the light goes, or a rectangle faces.
        rgb_linear: intensity, irradiance or radiance; of the environment pi times its mean radiance.
        sides_u: one side of a rectangle.
        sides_v: the other side.
        areas: of rectangles.
        cosines: of a spot's outer and inner angle.
        seen: whether rays meet the light, so that it counts for those too.
        environment_linear: the map, one black pixel without one.
        environment_rows: see :class:`engine.light.environment.EnvironmentSampler`, as the next two.
        environment_columns: cumulative shares within each row.
        environment_shares: share of each pixel.
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
    seen: Int32[np.ndarray, " l"]
    environment_linear: Float32[np.ndarray, "h w 3"]
    environment_rows: Float64[np.ndarray, " h1"]
    environment_columns: Float64[np.ndarray, "h w1"]
    environment_shares: Float64[np.ndarray, "h w"]
    environment_frame: Float64[np.ndarray, "3 3"]

    @property
    def environment_number(self) -> int:
        """The environment's place among the lights, -1 without one."""
        count = len(self.kinds)
        return count - 1 if count and self.kinds[-1] == ENVIRONMENT else -1


def light_arrays(
    lights: tuple[Light, ...], up_world: Float64[np.ndarray, "3"], environment: EnvironmentMap | None = None
) -> LightArrays:
    """Arrays of lights and the environment that shines together with them."""
    count = len(lights) + (environment is not None)
    kinds, seen = np.zeros(count, np.int32), np.zeros(count, np.int32)
    positions, axes, rgb, sides_u, sides_v = np.zeros((5, count, 3))
    areas, cosines = np.zeros(count), np.tile([0.0, 1.0], (count, 1))
    for l, light in enumerate(lights):
        colour = srgb_to_linear(np.array(light.colour_srgb))
        if not isinstance(light, DirectionalLight):
            positions[l] = light.position
        if not isinstance(light, PointLight):
            axes[l] = np.array(light.direction) / np.linalg.norm(light.direction)
        if isinstance(light, PointLight | SpotLight):
            kinds[l], rgb[l] = POINT, colour * light.intensity
            if isinstance(light, SpotLight):
                kinds[l] = SPOT
                cosines[l] = np.cos(np.radians([light.outer_degrees, light.inner_degrees]))
        elif isinstance(light, DirectionalLight):
            kinds[l], rgb[l] = DIRECTIONAL, colour * light.irradiance
        else:
            kinds[l], rgb[l], seen[l] = RECTANGLE, colour * light.radiance, light.visible
            sides_u[l], sides_v[l] = rectangle_sides(light, up_world)
            areas[l] = light.width * light.height
    radiance, frame = np.zeros((1, 1, 3), np.float32), np.eye(3)
    if environment is not None:
        radiance, frame = environment.radiance_linear, environment.frame
        kinds[-1], rgb[-1], seen[-1] = ENVIRONMENT, irradiance_mean(radiance), 1
    sampler = environment_sampler(radiance)
    return LightArrays(
        kinds, positions, axes, rgb, sides_u, sides_v, areas, cosines, seen,
        radiance, sampler.rows, sampler.columns, sampler.shares, frame,
    )  # fmt: skip


def rectangle_sides(
    light: RectangleLight, up_world: Float64[np.ndarray, "3"]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """The level side of a rectangle and the other, as vectors; their cross product is the way it faces."""
    facing = np.array(light.direction) / np.linalg.norm(light.direction)
    level = np.cross(up_world / np.linalg.norm(up_world), facing)
    if np.linalg.norm(level) < 1e-6:  # facing up or down: any level direction will do, the same each time
        level = np.cross(np.eye(3)[np.argmin(np.abs(facing))], facing)
    level /= np.linalg.norm(level)
    return level * light.width, np.cross(facing, level) * light.height


def look_up_environment(
    lights: LightArrays, directions_world: Float64[np.ndarray, "n 3"]
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
    """Linear radiance from unit directions, and the density with which they are sampled."""
    radiance, density = np.empty((len(directions_world), 3)), np.empty(len(directions_world))
    environment_values(lights, directions_world, radiance, density)
    return radiance, density


class LightSamples(NamedTuple):
    """Ways to lights from ``n`` points; see :func:`sample_lights`."""

    directions_world: Float64[np.ndarray, "n 3"]
    distances: Float64[np.ndarray, " n"]
    radiance_linear: Float64[np.ndarray, "n 3"]
    density: Float64[np.ndarray, " n"]
    lights: Int32[np.ndarray, " n"]


def sample_lights(
    lights: LightArrays, points_world: Float64[np.ndarray, "n 3"], uniform: Float64[np.ndarray, "n 3"]
) -> LightSamples:
    """A way from each point to one of the lights, which are asked by what they bring.

    The irradiance of a surface is the mean of radiance times cosine over density; where the density is 0,
    light comes from one direction only and ``radiance`` is irradiance already.
    """
    count = len(points_world)
    out = LightSamples(
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros(count, np.int32),
    )
    light_samples(lights, points_world, uniform, out[0], out[1], out[2], out[3], out[4])
    return out
