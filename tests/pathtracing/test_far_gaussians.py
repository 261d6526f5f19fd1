"""Gaussians that few paths come near to: the pixels of all others are traced among meshes alone."""

import numpy as np
import pytest

from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.gaussians.octagon import octagon_corners_world, octagon_radii
from octasplat.engine.pathtracing.gaussian_boxes import MAX_BOXES, bounding_boxes
from octasplat.engine.pathtracing.stage.materials import Diffuse, Mirror
from octasplat.engine.pathtracing.stage.model import (
    Integrator,
    RectangleLight,
    Stage,
    StageGaussians,
    StageMesh,
)
from tests.pathtracing.test_gaussians import cloud, picture
from tests.support.light_scenes import camera, film_of

LAMP = RectangleLight(position=(0, -1.9, 0), direction=(0, 1, 0), width=1, height=1, radiance=5)
INTEGRATOR = Integrator(samples=8, max_depth=4, roulette_depth=64)
OUT_OF_VIEW = (1.0, -0.5, 0.0)


def room(gaussians: StageGaussians, *, closed: bool) -> Stage:
    """A matt room with a mirror ball under a lamp; if it is not closed, its floor alone."""
    walls = StageMesh(shape="cube", scale=4, material=Diffuse())
    floor = StageMesh(shape="plane", scale=4, position=(0, 0.5, 0), material=Diffuse())
    ball = StageMesh(shape="sphere", scale=0.5, smooth_degrees=180, material=Mirror())
    return Stage(
        gaussians=(gaussians,),
        meshes=(walls if closed else floor, ball),
        lights=(LAMP,),
        integrator=INTEGRATOR,
    )


def faint(size: float) -> FlatGaussians:
    """A Gaussian that shows nothing, but whose box surrounds everything."""
    turned = np.float32([[1, 0, 0, 0], [np.sqrt(0.5), 0, np.sqrt(0.5), 0]])
    return FlatGaussians(
        np.zeros((2, 3), np.float32),
        turned,
        np.full((2, 2), np.log(size), np.float32),
        np.full(2, -12.0, np.float32),
        np.zeros((2, 4, 3), np.float32),
    )


def test_gaussians_behind_walls_change_no_byte() -> None:
    stage = room(StageGaussians(light="emissive"), closed=True)
    view = camera((0, -0.5, -1.8), (0, 0, 0))
    outside = cloud(200, centre=(0, 0, 30))
    alone = film_of(stage, view).image().rgb_srgb
    assert np.array_equal(picture(stage, view, outside), alone)
    assert alone.std() > 0.05


@pytest.mark.parametrize("light", ["emissive", "shadowed", "relit"])
@pytest.mark.parametrize("centre", [(0.0, -0.8, 0.0), OUT_OF_VIEW])
def test_pixels_near_and_far_are_those_of_the_wavefront(light: str, centre: tuple[float, ...]) -> None:
    stage = room(StageGaussians(light=light), closed=False)
    view = camera((0, -1.2, -1.8), (0, 0.2, 0), fov=30)
    near = cloud(150, spread=0.2, centre=centre)
    # with a box around everything all pixels are traced with the Gaussians
    expected = picture(stage, view, concatenate([near, faint(50.0)]))
    assert np.abs(picture(stage, view, near) - expected).max() < 2e-3
    # what is out of view shadows the floor or is mirrored there
    assert np.abs(expected - film_of(stage, view).image().rgb_srgb).max() > 0.05
    assert np.abs(expected - picture(stage, view, near, threads=1)).max() < 2e-3


def test_the_number_of_threads_changes_no_byte() -> None:
    stage = room(StageGaussians(light="shadowed"), closed=False)
    view = camera((0, -1.2, -1.8), (0, 0.2, 0), (200, 150))
    near = cloud(150, spread=0.2, centre=OUT_OF_VIEW)
    pictures = [picture(stage, view, near, threads=threads) for threads in (1, 2, 3)]
    assert np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[0], pictures[2])


@pytest.mark.parametrize("count", [0, 1, 5, 1000])
def test_boxes_hold_all_corners(count: int) -> None:
    gaussians = cloud(count, seed=count)
    boxes = bounding_boxes(gaussians, 9.21)
    assert len(boxes) == min(count, MAX_BOXES)
    corners = octagon_corners_world(gaussians, octagon_radii(gaussians.opacities, 9.21)).reshape(-1, 1, 3)
    inside = ((corners >= boxes[:, :3]) & (corners <= boxes[:, 3:])).all(axis=2).any(axis=1)
    assert inside.all()
