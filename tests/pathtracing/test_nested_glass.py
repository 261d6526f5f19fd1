"""Glass in glass with priorities: Fresnel, Snell and Beer at every surface; overlaps are not there."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.pathtracing.stage.materials import Diffuse, Glass
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Environment,
    Integrator,
    RectangleLight,
    Stage,
    StageMesh,
)
from octasplat.engine.render.image_files import write_exr
from tests.support.light_scenes import camera, film_of

AHEAD = camera((0, 0, -4), (0, 0, 0), (8, 8), 0.5)
WHITE = (1.0, 1.0, 1.0)


def slab(low: float, high: float, material: Glass, half: float = 20) -> StageMesh:
    return StageMesh(
        shape="cube", position=(0, 0, (low + high) / 2), scale=(half, half, (high - low) / 2),
        material=material,
    )  # fmt: skip


def glass(ior: float, absorption: float, priority: int | None) -> Glass:
    return Glass(ior=ior, absorption=(absorption,) * 3, priority=priority)


def seen_through(folder: Path, *meshes: StageMesh) -> float:
    """The share of a wall's light that comes straight through slabs, whatever they reflect to each other."""
    wall = RectangleLight(position=(0, 0, 3), direction=(0, 0, -1), width=40, height=40, radiance=1.0)
    numbers = Integrator(samples=1024, max_depth=32, roulette_depth=32, anti_aliasing=False)
    stage = Stage(gaussians=(), meshes=meshes, lights=(wall,), integrator=numbers)
    return float(film_of(stage, AHEAD, folder).image().rgb_linear.mean())


def stack(indices: list[float], ways: list[float]) -> float:
    """Light through a stack: Fresnel head-on between neighbors, ``ways`` the optical depth of each inside."""
    passed, from_back = 1.0, 0.0
    for k, (near, far) in enumerate(pairwise(indices)):
        reflected = ((near - far) / (near + far)) ** 2
        kept = np.exp(-ways[k])
        back = from_back * kept**2
        round_trips = 1 - back * reflected
        from_back = reflected + (1 - reflected) ** 2 * back / round_trips
        passed *= kept * (1 - reflected) / round_trips
    return passed


def test_stack_of_one_slab_is_the_closed_form() -> None:
    inside = np.exp(-0.7)
    assert stack([1, 1.5, 1], [0, 0.7]) == pytest.approx(0.96**2 * inside / (1 - (0.04 * inside) ** 2))


@pytest.mark.parametrize("priorities", [(1, 2), (1, 1)])
def test_slab_within_slab_follows_fresnel_and_beer_at_each_surface(
    priorities: tuple[int, int], tmp_path: Path
) -> None:
    outer, inner = (
        slab(-1, 1, glass(1.5, 0.2, priorities[0])), slab(-0.4, 0.4, glass(2.4, 0.5, priorities[1]))
    )  # fmt: skip
    expected = stack([1, 1.5, 2.4, 1.5, 1], [0, 0.2 * 0.6, 0.5 * 0.8, 0.2 * 0.6])
    assert seen_through(tmp_path, outer, inner) == pytest.approx(expected, abs=0.004)


def test_glass_of_lower_priority_is_not_there_within_other_glass(tmp_path: Path) -> None:
    outer = slab(-1, 1, glass(1.5, 0.2, 5))
    alone = stack([1, 1.5, 1], [0, 0.4])
    for low, high in ((-0.4, 0.4), (-1, 0.4)):
        hidden = slab(low + 0.01, high, glass(2.4, 0.5, 4))
        assert seen_through(tmp_path, outer, hidden) == pytest.approx(alone, abs=0.004)


def test_liquid_that_overlaps_the_walls_of_its_glass_touches_them(tmp_path: Path) -> None:
    walls = (slab(-1, -0.4, glass(1.5, 0.2, 2)), slab(0.4, 1, glass(1.5, 0.2, 2)))
    liquid = slab(-0.5, 0.6, glass(1.33, 0.5, 1))
    expected = stack([1, 1.5, 1.33, 1.5, 1], [0, 0.2 * 0.6, 0.5 * 0.8, 0.2 * 0.6])
    assert seen_through(tmp_path, *walls, liquid) == pytest.approx(expected, abs=0.004)
    # Walls without a priority stand in air, and the liquid ends at them.
    loose = [m.model_copy(update={"material": glass(1.5, 0.2, None)}) for m in walls]
    assert seen_through(tmp_path, *loose, liquid) > expected + 0.05


def test_oblique_ray_through_slab_in_slab_follows_snell_at_each_surface(tmp_path: Path) -> None:
    meshes = (slab(-1, 1, glass(1.5, 0, 1)), slab(-0.5, 0.5, glass(2.4, 0, 2)))
    numbers = Integrator(samples=256, max_depth=5, anti_aliasing=False)
    view = camera((-4, 0, -4), (0, 0, 0), (3, 3), 1e-4)

    def advance(ior: float) -> float:
        sine = np.sin(np.pi / 4) / ior
        return float(sine / np.sqrt(1 - sine**2))

    arrives = -4 + 6 + advance(1.5) + advance(2.4)  # where it meets the plane z = 4: six units are air
    for offset, bright in ((-0.06, True), (0.06, False)):
        lamp = RectangleLight(
            position=(arrives + offset + 1.0, 0, 4), direction=(0, 0, -1), width=2, height=1, radiance=1.0
        )
        stage = Stage(gaussians=(), meshes=meshes, lights=(lamp,), integrator=numbers)
        seen = film_of(stage, view, tmp_path).image().rgb_linear.mean()
        assert (seen > 0.6) == bright, (offset, seen)


def lying(low: float, high: float, material: Glass) -> StageMesh:
    return StageMesh(
        shape="cube", position=(0, (low + high) / 2, 0), scale=(20, (high - low) / 2, 20), material=material
    )


def floor(y: float) -> StageMesh:
    return StageMesh(shape="plane", position=(0, y, 0), scale=19, material=Diffuse(color_srgb=WHITE))


def test_light_of_the_sun_goes_straight_through_glass_in_glass(tmp_path: Path) -> None:
    sun = DirectionalLight(direction=(0, 1, 0), irradiance=np.pi)
    numbers = Integrator(samples=1, max_depth=1, anti_aliasing=False)
    view = camera((-3, 0.5, 0), (0, 1, 0), (3, 3), 1e-3)
    nested = (lying(-3, -1, glass(1.5, 0.2, 1)), lying(-2.4, -1.6, glass(2.4, 0.5, 2)))
    overlapping = (
        lying(-3, -2.4, glass(1.5, 0.2, 3)), lying(-2.5, -1.5, glass(2.4, 0.5, 1)),
        lying(-1.6, -1, glass(1.5, 0.2, 2)),
    )  # fmt: skip
    once = 1 - (0.9 / 3.9) ** 2
    for meshes in (nested, overlapping):
        stage = Stage(gaussians=(), meshes=(floor(1), *meshes), lights=(sun,), integrator=numbers)
        seen = film_of(stage, view, tmp_path).image().rgb_linear
        expected = 0.96**2 * once**2 * np.exp(-0.2 * 1.2 - 0.5 * 0.8)
        np.testing.assert_allclose(seen, expected, rtol=1e-4)


def test_floor_in_a_liquid_in_glass_is_lit_and_seen_by_the_way_in_each(tmp_path: Path) -> None:
    sun = DirectionalLight(direction=(0, 1, 0), irradiance=np.pi)
    numbers = Integrator(samples=1, max_depth=8, anti_aliasing=False)
    # of index 1, so that nothing is reflected: down through 0.5 of glass and 0.7 of liquid, and up again
    meshes = (lying(-1, 2, glass(1.0, 0.3, 1)), lying(-0.5, 1.5, glass(1.0, 0.8, 2)))
    stage = Stage(gaussians=(), meshes=(floor(0.2), *meshes), lights=(sun,), integrator=numbers)
    view = camera((0, -4, 1e-3), (0, 0, 0), (3, 3), 1e-3)
    seen = film_of(stage, view, tmp_path).image().rgb_linear
    np.testing.assert_allclose(seen, np.exp(-2 * (0.3 * 0.5 + 0.8 * 0.7)), rtol=1e-3)


@pytest.mark.parametrize("roughness", [0.0, 0.4])
def test_white_things_in_overlapping_glass_cannot_be_seen_in_white_surroundings(
    roughness: float, tmp_path: Path
) -> None:
    write_exr(tmp_path / "white.exr", {c: np.ones((8, 16), np.float32) for c in "RGB"})

    def ball(x: float, radius: float, material: Glass | Diffuse) -> StageMesh:
        return StageMesh(
            shape="sphere", position=(x, 0, 0), scale=radius, smooth_degrees=180, material=material
        )

    meshes = (
        ball(0, 1, Glass(ior=1.5, roughness=roughness, priority=2)),
        ball(0.7, 0.8, Glass(ior=1.33, priority=1)),
        # half of it in the part of the second that is not there
        ball(0.2, 0.4, Diffuse(color_srgb=WHITE)),
    )
    stage = Stage(
        gaussians=(), meshes=meshes, environment=Environment(file="white.exr"),
        integrator=Integrator(samples=64, max_depth=64, roulette_depth=64),
    )  # fmt: skip
    seen = film_of(stage, camera((0, 0, -4), (0.3, 0, 0), (24, 16), 35), tmp_path).image().rgb_linear
    # what the facets of a rough surface between two glasses throw at each other is lost
    assert seen.mean() == pytest.approx(1.0, abs=0.01 if roughness == 0.0 else 0.02)
