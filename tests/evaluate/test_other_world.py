"""Photographs of another world than the scene's are told apart by their cameras."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.psnr import psnr
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.model import PosedView, Viewpoints
from octasplat.engine.evaluate.other_world import OtherWorldCheck, blind_views, even_color_psnr, far_views
from octasplat.engine.evaluate.view_metrics import RenderedView
from octasplat.engine.gaussians.model import FlatGaussians


def cameras_around(radius: float, *, away: bool = False, count: int = 6) -> Viewpoints:
    """Cameras on a circle that look at the origin, or away from it."""
    views = []
    for index, angle in enumerate(np.linspace(0.0, 2 * np.pi, count, endpoint=False)):
        place = radius * np.array([np.cos(angle), np.sin(angle), 0.0])
        forward = place / radius if away else -place / radius
        right = np.cross([0.0, 0.0, 1.0], forward)
        turn = np.stack([right, np.cross(forward, right), forward])
        views.append(PosedView(f"{index}.png", 0, turn, -turn @ place, 64, 48))
    return Viewpoints(tuple(views), (Camera("PINHOLE", (60.0, 60.0, 32.0, 24.0), 64, 48),))


def scene(count: int = 500) -> FlatGaussians:
    random = np.random.default_rng(0)
    return FlatGaussians(
        means_world=random.uniform(-1, 1, (count, 3)).astype(np.float32),
        quats_wxyz=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 2), -3.0, np.float32),
        opacity_logits=np.zeros(count, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


@pytest.mark.parametrize(("away", "blind"), [(False, 0), (True, 6)])
def test_cameras_that_look_away_do_not_see_the_scene(away: bool, blind: int) -> None:
    assert blind_views(cameras_around(4.0, away=away), scene()).sum() == blind


@pytest.mark.parametrize(("radius", "far"), [(4.0, 0), (20.0, 0), (60.0, 6)])
def test_cameras_far_beyond_those_of_the_run_are_known(radius: float, far: int) -> None:
    assert far_views(cameras_around(4.0), cameras_around(radius), extent_world=4.0).sum() == far


def test_even_color_psnr_is_that_of_the_variance() -> None:
    photograph = np.zeros((4, 4, 3), np.float32)
    photograph[:2] = 1.0
    assert even_color_psnr(photograph, np.ones((4, 4), np.float32)) == pytest.approx(-10 * np.log10(0.25))
    upper = np.zeros((4, 4), np.float32)
    upper[:2] = 1.0
    assert even_color_psnr(photograph, upper) == np.inf


@pytest.mark.parametrize(
    ("level", "run_psnr", "warns"),
    [(0.0, 25.0, True), (0.0, None, True), (0.0, 3.0, False), (0.9, 25.0, False)],
)
def test_renders_worse_than_an_even_color_are_warned_of(
    level: float, run_psnr: float | None, warns: bool
) -> None:
    """``level`` is how much of the photograph a render shows; the rest is its negative."""
    random = np.random.default_rng(0)
    check = OtherWorldCheck(Path("others"), None, run_psnr)
    for _ in range(3):
        photograph = random.uniform(size=(6, 6, 3)).astype(np.float32)
        render = level * photograph + (1 - level) * (1 - photograph)
        weight = np.ones((6, 6), np.float32)
        view = RenderedView("a.png", render, photograph, weight, None, {}, None)
        check.add(view, psnr(render, photograph, weight))
    message = check.warn_of_renders()
    assert (message is not None) == warns
    if message is not None:
        assert "3 of 3 renders" in message and "others" in message
