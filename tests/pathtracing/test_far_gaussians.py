"""Gaussians that few paths come near to: the pixels of all others are traced among meshes alone."""

from pathlib import Path

import numpy as np
import pytest
from numba import njit

from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.gaussians.octagon import octagon_corners_world, octagon_radii
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.gaussian_boxes import MAX_BOXES, bounding_boxes
from octasplat.engine.pathtracing.gaussian_layers import build_gaussian_layers
from octasplat.engine.pathtracing.kernels.box_tests import enters_any_box, make_ray
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.materials import Diffuse, Mirror
from octasplat.engine.pathtracing.stage.model import (
    Integrator,
    RectangleLight,
    Stage,
    StageGaussians,
    StageMesh,
)
from octasplat.engine.trace.protocol import TraceSettings
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
    boxes = bounding_boxes(gaussians, 9.21).T
    assert len(boxes) == min(count, MAX_BOXES)
    corners = octagon_corners_world(gaussians, octagon_radii(gaussians.opacities, 9.21)).reshape(-1, 1, 3)
    inside = ((corners >= boxes[:, :3]) & (corners <= boxes[:, 3:])).all(axis=2).any(axis=1)
    assert inside.all()


@njit
def each_enters(boxes, origins, directions, t_max):  # type: ignore[no-untyped-def]
    """Whether each ray enters a box."""
    found = np.zeros(len(origins), np.bool_)
    for k in range(len(origins)):
        found[k] = enters_any_box(make_ray(origins[k], directions[k]), boxes, t_max[k])
    return found


@pytest.mark.parametrize("distance", [1.0, 1e4, 1e9, 1e15])
def test_rays_along_an_axis_enter_boxes_however_far_they_start(distance: float) -> None:
    box = np.float32([[-0.5, -0.5, -0.5, 0.5, 0.5, 0.5]]).T
    beside, zeros = np.linspace(-0.499, 0.499, 5), np.zeros(25)
    across, along = (part.ravel() for part in np.meshgrid(beside, beside))
    for axis in range(3):
        for way in (-1.0, 1.0):
            origins = np.roll(np.stack([zeros - way * distance, across, along], axis=1), axis, axis=1)
            directions = np.roll(np.stack([zeros + way, zeros, zeros], axis=1), axis, axis=1)
            rays = origins.astype(np.float32), directions.astype(np.float32)
            assert each_enters(box, *rays, np.full(25, np.inf, np.float32)).all()


def test_rays_that_enter_boxes_are_found() -> None:
    rng = np.random.default_rng(5)
    low = rng.uniform(-3, 3, (20, 3))
    boxes = np.concatenate([low, low + rng.uniform(0, 1, (20, 3))], axis=1).T.astype(np.float32)
    to = rng.uniform(-4, 4, (4000, 3)).astype(np.float32)
    origins = rng.uniform(-4, 4, (4000, 3)).astype(np.float32)
    origins[::4, 1:], origins[1::4, 0] = to[::4, 1:], to[1::4, 0]  # along an axis, and across one
    origins[2::4] *= 1000
    away = (to - origins).astype(np.float32)
    t_max = np.linalg.norm(away, axis=1).astype(np.float32)
    directions = away / t_max[:, None]
    found = each_enters(boxes, origins, directions, t_max)
    steps = origins[:, None] + (to - origins)[:, None] * np.linspace(0, 1, 200, dtype=np.float32)[:, None]
    inside = ((steps[..., None] >= boxes[:3]) & (steps[..., None] <= boxes[3:])).all(axis=2).any(axis=(1, 2))
    assert found[inside].all()
    assert 0.05 < inside.mean() < 0.9
    # slabs in float64, without room for rounding
    with np.errstate(divide="ignore", invalid="ignore"):
        cuts = (boxes.reshape(2, 3, 1, -1) - origins.T[:, :, None].astype(np.float64)) / directions.T[
            ..., None
        ]
    near = np.nanmax(cuts.min(axis=0), axis=0)
    far = np.nanmin(cuts.max(axis=0), axis=0)
    exact = (np.maximum(near, 0) <= np.minimum(far, t_max[:, None])).any(axis=1)
    assert (found != exact).mean() < 0.01


def test_rays_that_meet_no_gaussian_are_not_traced_with_them() -> None:
    stage = room(StageGaussians(light="shadowed"), closed=True)
    view = camera((0, -0.5, -1.8), (0, 0, 0))
    outside = cloud(300, spread=3.0, centre=(0, 20, 0))
    layers = build_gaussian_layers(stage, outside, pytest.fail, Path(), TraceSettings(), size=1.0)
    assert layers is not None
    layers.tracer.trace = layers.tracer.transmittance = None  # type: ignore[assignment,method-assign]
    tracer = PathTracer(PathTracerScene(compile_meshes(stage, Path()), layers), INTEGRATOR)
    assert np.array_equal(tracer.render(view.rays()).image().rgb_srgb, film_of(stage, view).image().rgb_srgb)
