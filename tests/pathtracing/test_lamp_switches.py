"""Lamps that only cast shadows, that cast none, and that do not light meshes."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from octasplat.engine.pathtracing.stage.materials import Diffuse, Glass
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Integrator,
    PointLight,
    RectangleLight,
    Stage,
    StageGaussians,
    StageMesh,
)
from tests.pathtracing.test_gaussians import picture, plainly, wall
from tests.support.light_scenes import camera, film_of

DIRECT = Integrator(samples=4, max_depth=1, anti_aliasing=False)
SCREEN = wall(0.0, 2.0)
PLATE = StageMesh(shape="cube", scale=(1, 1, 0.01), position=(-1, 0, -1), material=Diffuse())
BESIDE = camera((2.0, 0, -0.8), (-0.3, 0, 0), (41, 5), 12)
"""Sees the wall from the side, so that the plate itself is not in the way."""
BLACK = (0.0, 0.0, 0.0)
FLOOR = StageMesh(shape="plane", position=(0, 1, 0), scale=9, material=Diffuse(color_srgb=(1, 1, 1)))
LID = StageMesh(shape="plane", position=(0, -1, 0), scale=9, material=Diffuse(color_srgb=BLACK))
PANE = StageMesh(shape="cube", scale=(3, 0.1, 3), position=(0, -1, 0), material=Glass(ior=1.5))
BELOW = camera((-3, 0.5, 0), (0, 1, 0), (3, 3), 1e-3)


def sun(**more: Any) -> DirectionalLight:
    return DirectionalLight(direction=(0, 0, 1), irradiance=5, **more)


def linear(srgb: np.ndarray) -> np.ndarray:
    return np.asarray(((srgb + 0.055) / 1.055) ** 2.4)


def darkening(*lights: Any, light: Any = "shadowed", meshes: tuple[StageMesh, ...] = (PLATE,)) -> np.ndarray:
    """What the stage makes of the wall's own light, along a row that begins in the plate's shadow."""
    stage = Stage(
        gaussians=(StageGaussians(light=light, ambient=0.25),), meshes=meshes, lights=lights,
        integrator=DIRECT,
    )  # fmt: skip
    shown, lit = linear(picture(stage, BESIDE, SCREEN)), linear(plainly(SCREEN, BESIDE))
    return np.asarray((shown / lit)[2, 18:, 0])  # left of that the wall ends


def floor_radiance(lamp: Any, *meshes: StageMesh, depth: int = 1, samples: int = 4) -> float:
    numbers = Integrator(samples=samples, max_depth=depth, anti_aliasing=False)
    stage = Stage(meshes=(FLOOR, *meshes), lights=(lamp,), integrator=numbers)
    return float(film_of(stage, BELOW).image().rgb_linear.mean())


def test_lamp_of_shadows_alone_darkens_gaussians_and_lights_nothing() -> None:
    found = darkening(sun(only_shadows=True))
    # As of any lamp of the photographs: a quarter is left in the shadow, all of it elsewhere.
    np.testing.assert_array_equal(found, darkening(sun()))
    assert abs(found[-5:].mean() - 1) < 1e-3 and np.median(found[found < 0.5]) == pytest.approx(
        0.25, abs=0.01
    )
    assert floor_radiance(DirectionalLight(direction=(0, 1, 0), irradiance=5, only_shadows=True)) == 0.0


def test_lamp_of_shadows_alone_needs_shadowed_gaussians() -> None:
    lamp = sun(only_shadows=True)
    # some are enough
    scenes = (StageGaussians(light="relit"), StageGaussians(file="small.ply"))
    Stage(gaussians=scenes, lights=(lamp,))
    for light in ("relit", "emissive"):
        with pytest.raises(ValidationError, match=r"shadows of lights\[0\] .* give \[\[gaussians\]\]"):
            Stage(gaussians=(StageGaussians(light=light),), lights=(lamp,))
    with pytest.raises(ValidationError, match="this stage has none"):
        Stage(gaussians=(), lights=(lamp,))


def test_lamp_of_shadows_alone_is_not_seen() -> None:
    ball = PointLight(position=(0, 0, 0), intensity=1, radius=0.5, only_shadows=True)
    stage = Stage(lights=(ball,), integrator=DIRECT)
    assert not film_of(stage, camera((0, 0, -4), (0, 0, 0), (5, 5), 5)).image().rgb_linear.any()


def test_lamp_without_shadows_reaches_everything_and_takes_nothing() -> None:
    down = DirectionalLight(direction=(0, 1, 0), irradiance=np.pi, casts_shadows=False)
    assert floor_radiance(down, LID) == pytest.approx(1.0, rel=1e-5)
    np.testing.assert_allclose(darkening(sun(casts_shadows=False)), 1.0, atol=1e-3)
    # Another lamp's shadow is as dark as without it.
    beside = darkening(sun(), sun(casts_shadows=False))
    assert np.median(beside[beside < 0.5]) == pytest.approx(0.25, abs=0.02)
    # New light goes through the plate: the wall's own, and as a matt surface of its color.
    added = darkening(sun(casts_shadows=False, adds_light=True))
    np.testing.assert_allclose(added, 1 + 5 / np.pi, rtol=2e-3)


def test_visible_lamp_without_shadows_lights_as_if_nothing_were_in_its_way() -> None:
    lamp = {"position": (0, -3, 0), "direction": (0, 1, 0), "width": 2.0, "height": 2.0, "radiance": 10.0}
    x = 1 / np.hypot(1, 4)
    expected = 10 * 4 * x / np.pi * np.arctan(x)
    for depth in (1, 2):
        for meshes in ((), (LID,)):
            found = floor_radiance(
                RectangleLight(**lamp, casts_shadows=False), *meshes, depth=depth, samples=1024
            )
            assert found == pytest.approx(expected, rel=5e-3)


def test_light_of_a_lamp_without_shadows_comes_through_glass_once() -> None:
    lamp = RectangleLight(
        position=(0, -3, 0), direction=(0, 1, 0), width=2, height=2, radiance=10, casts_shadows=False
    )
    alone = floor_radiance(lamp, depth=6, samples=1024)
    # the pane sends a little of what the floor reflects back to it, some 7 %
    assert alone < floor_radiance(lamp, PANE, depth=6, samples=1024) < 1.1 * alone


def test_lamp_that_does_not_light_meshes_is_seen_and_lights_gaussians() -> None:
    lamp = RectangleLight(
        position=(0, -3, 0), direction=(0, 1, 0), width=2, height=2, radiance=10, lights_meshes=False
    )
    for meshes in ((), (PANE,)):
        assert floor_radiance(lamp, *meshes, depth=6, samples=64) == 0.0
    below = camera((0, 0.5, 1e-3), (0, -3, 0), (3, 3), 1)
    stage = Stage(gaussians=(), meshes=(FLOOR,), lights=(lamp,), integrator=DIRECT)
    np.testing.assert_allclose(film_of(stage, below).image().rgb_linear, 10.0, rtol=1e-5)
    added = darkening(sun(lights_meshes=False, adds_light=True), meshes=())
    np.testing.assert_allclose(added, 1 + 5 / np.pi, rtol=2e-3)
