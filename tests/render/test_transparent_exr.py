"""Edges of transparent EXR pictures have the color of what they are edges of."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.pathtracing.relighting.relighter import Relighter
from octasplat.engine.pathtracing.relighting.relit_images import RelitRenderFn, ShotLighting
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.pose_paths import look_at
from octasplat.engine.render.shots import Shot, scene_render_fn
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.image_channels import read_channels

RGB_SRGB = np.array([0.9, 0.5, 0.2], np.float32)


def shot() -> Shot:
    pose = look_at(np.array([0.0, 0, -3]), np.zeros(3), np.array([0.0, -1, 0]))
    camera = PinholeCamera.from_pose(pose, 24, 24, fy_px=24.0)
    return Shot("a", camera.rays)


def assert_edges_have_the_color(path: Path) -> None:
    layers = read_channels(path)
    edge = (layers["A"] > 0.02) & (layers["A"] < 0.9)
    assert edge.sum() > 20
    for name, value in zip("RGB", srgb_to_linear(RGB_SRGB), strict=True):
        np.testing.assert_allclose(layers[name][edge] / layers["A"][edge], value, rtol=2e-3)


def test_transparent_exr_edges_of_render_are_premultiplied(tmp_path: Path) -> None:
    disc = FlatGaussians(
        np.zeros((1, 3), np.float32),
        np.array([[np.sqrt(0.5), 0, -np.sqrt(0.5), 0]], np.float32),
        np.full((1, 2), np.log(0.4), np.float32),
        np.full(1, 3.0, np.float32),
        ((RGB_SRGB - 0.5) / np.float32(SH_C0)).reshape(1, 1, 3),
    )
    tracer = make_tracer(TraceSettings(), threads=1)
    tracer.build(disc)
    paint = scene_render_fn(tracer, np.zeros(3, np.float32), transparent=True)
    paint(shot(), tmp_path / "a.exr", lambda _share: None)
    assert_edges_have_the_color(tmp_path / "a.exr")


@pytest.fixture
def relighter() -> Callable[[np.ndarray], Relighter]:
    """A relighter that shows one color, covering as given."""

    def make(coverage: np.ndarray) -> Relighter:
        linear = np.broadcast_to(srgb_to_linear(RGB_SRGB), (*coverage.shape, 3)).astype(np.float32)

        def over(background: np.ndarray) -> np.ndarray:
            return linear_to_srgb(linear) * coverage[..., None] + background * (1 - coverage[..., None])

        image = SimpleNamespace(linear=linear, coverage=coverage, composite_over=over)
        relighter = SimpleNamespace(set_environment=lambda _map: None, render=lambda _rays, _part: image)
        return cast(Relighter, relighter)

    return make


def test_transparent_exr_edges_of_relight_are_premultiplied(
    relighter: Callable[[np.ndarray], Relighter], tmp_path: Path
) -> None:
    coverage = np.linspace(0, 1, 24 * 24, dtype=np.float32).reshape(24, 24)
    one, grey = shot(), np.ones((4, 8, 3), np.float32)
    paint = RelitRenderFn(
        relighter(coverage), {"e": grey}, np.array([0.0, -1, 0]), "transparent", {one: ShotLighting("e", 0.0)}
    )
    paint(one, tmp_path / "a.exr", lambda _share: None)
    assert_edges_have_the_color(tmp_path / "a.exr")
