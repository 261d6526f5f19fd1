"""Pictures of a training come every few seconds, cost little and change nothing."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.events import Event
from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.dataset import Dataset
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pipeline import OnStep, reconstruct
from octasplat.engine.render.renderer import render_rays
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer
from octasplat.workers.worker import preview
from octasplat.workers.worker.preview import PreviewRenderer, PreviewWritten
from tests.support.tiny_dataset import make_tiny_dataset
from tests.support.watched_training import watched_config


class Clock:
    """Time that passes when it is told to."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(preview, "time", SimpleNamespace(monotonic=clock.monotonic))
    return clock


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, width_px=48, height_px=36, points=500)


def watched(clock: Clock, previews: PreviewRenderer, seconds: float) -> OnStep:
    """Every iteration takes so many seconds."""

    def watch(
        iteration: int, dataset: Dataset, tracer: Tracer, shading: ShadingModel, _gaussians: FlatGaussians
    ) -> None:
        clock.now += seconds
        previews(iteration, dataset, tracer, shading)

    return watch


def told_steps(run: Path, told: list[Event]) -> list[int]:
    found = [event for event in told if isinstance(event, PreviewWritten)]
    assert all((run / event.path).is_file() and event.view == "view_000.png" for event in found)
    return [event.step for event in found]


@pytest.mark.exhaustive
@pytest.mark.parametrize("materials", [False, pytest.param(True, marks=pytest.mark.exhaustive)])
def test_previews_do_not_change_training(scene: Path, tmp_path: Path, clock: Clock, materials: bool) -> None:
    config = watched_config(materials=materials)
    whole = reconstruct(scene, tmp_path / "whole", config, threads=1)
    told: list[Event] = []
    run = tmp_path / "run"
    watch = watched(clock, PreviewRenderer(run, "black", told.append), 1.0)
    reconstruct(scene, run, config, threads=1, on_step=watch)
    # At once, after 4 s, and then every 12 s; one that falls on a densification waits for the next iteration.
    steps = told_steps(run, told)
    assert len(steps) == 6 and steps[0] == 1
    assert all(12 <= b - a <= 14 for a, b in pairwise(steps[1:]))
    drawn_often = tmp_path / "often"
    watch = watched(clock, PreviewRenderer(drawn_often, "black", lambda _event: None), 60.0)
    reconstruct(scene, drawn_often, config, threads=1, on_step=watch)
    for name in ("scene.ply", "mesh.ply", "checkpoints/best.npz", "renders/view_000.png"):
        expected = (whole / name).read_bytes()
        assert (run / name).read_bytes() == expected and (drawn_often / name).read_bytes() == expected


@pytest.mark.exhaustive
def test_preview_shows_materials(scene: Path, tmp_path: Path) -> None:
    """The newest picture is what the shading model of the training makes of the view, not its harmonics."""
    run = tmp_path / "run"
    previews = PreviewRenderer(run, "black", lambda _event: None)
    shown = []

    def watch(
        iteration: int, dataset: Dataset, tracer: Tracer, shading: ShadingModel, _gaussians: FlatGaussians
    ) -> None:
        if iteration != 40:
            return
        previews(iteration, dataset, tracer, shading)
        rays = preview.grid_rays(dataset, int(dataset.test_indices[0]), preview.MAX_SIDE_PX)
        black = np.zeros(3, np.float32)
        shown.extend(
            to_bytes(render_rays(tracer, rays, black, by).rgb_srgb) for by in (shading, PLAIN_SHADING)
        )

    reconstruct(scene, run, watched_config(materials=True), threads=1, on_step=watch)
    with Image.open(run / preview.PREVIEW_FILE) as picture:
        values = np.asarray(picture)
    assert (values == shown[0]).all() and (values != shown[1]).any()


@pytest.mark.parametrize(("seconds_per_ray", "least_side_px"), [(1e-9, 320), (2e-5, 120), (1e-2, 96)])
def test_previews_shrink_when_slow(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch, seconds_per_ray: float, least_side_px: int
) -> None:
    """A picture takes at most 2 % of 12 s, or is as small as pictures become."""

    def rays(view: np.ndarray, _y: np.ndarray, _x: np.ndarray) -> RayBatch:
        return RayBatch(np.zeros((1, 3), np.float32), np.zeros((len(view), 3), np.float32))

    def render(_tracer: None, image: ImageRays, _background: np.ndarray, _shading: object) -> Any:
        clock.now += seconds_per_ray * image.height_px * image.width_px
        return SimpleNamespace(rgb_srgb=image.directions_world)

    monkeypatch.setattr(preview, "render_rays", render)
    view = SimpleNamespace(name="a.jpg", width_px=1600, height_px=1200, origin_world=np.zeros(3))
    dataset = SimpleNamespace(views=(view,), test_indices=np.array([0]), rays=rays, near_world=0.0)
    draw: Callable[..., None] = PreviewRenderer(tmp_path, "black", lambda _event: None)
    for iteration in range(4):
        draw(iteration, dataset, None, PLAIN_SHADING)
        clock.now += 1000
    with Image.open(tmp_path / preview.PREVIEW_FILE) as picture:
        width, height = picture.size
    assert least_side_px <= width <= 320 and abs(width * 0.75 - height) <= 1
    assert width == 96 or seconds_per_ray * width * height <= 0.25
