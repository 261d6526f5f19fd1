"""Photographs whose poses are wrong are found, named, and left out where that is asked for."""

import json
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import CheckpointWritten, Event, Warned
from octasplat.engine.dataset import DatasetView
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.train.views import outlier_views as misfit_module
from octasplat.engine.train.views.outlier_views import ViewPsnr, find_outlier_views

SPOILED = ["view_010.png", "view_025.png"]
SETTINGS = (
    "iterations=300", "rays_per_batch=2048", "max_gaussians=1000", "checkpoint_every=50", "probe_rays=512",
)  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A generated scene in which two photographs have each other's poses."""
    root = tmp_path_factory.mktemp("spoiled") / "scene"
    write_synthetic_dataset(
        root, SyntheticDatasetConfig(views=32, width_px=64, height_px=48, samples_per_side=2, points=1500)
    )
    one, other = (root / "images" / name for name in SPOILED)
    first = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(first)
    return root


def run(
    scene: Path, output: Path, *more: str, should_stop: Callable[[list[Event]], bool] = lambda _events: False
) -> list[str]:
    """The warnings of a run."""
    config = resolve_config("fast", settings={"exports": ()}, assignments=[*SETTINGS, *more])
    events: list[Event] = []
    reconstruct(
        scene, output, config, resume=True, threads=1,
        progress=events.append, should_stop=lambda: should_stop(events),
    )  # fmt: skip
    return [event.message for event in events if isinstance(event, Warned)]


def measured(output: Path) -> tuple[dict, float]:
    training = json.loads((output / "training.json").read_text())["training_views"]
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["training_views"] == training
    return training, metrics["mean"]["psnr"]


@pytest.mark.exhaustive
def test_outlier_views_match_wrong_poses(scene: Path, tmp_path: Path) -> None:
    told = run(scene, tmp_path / "all")
    with_all, psnr = measured(tmp_path / "all")
    assert sorted(with_all["misfits"]) == SPOILED
    assert with_all["left_out"] == [] and len(with_all["views"]) == 28
    assert any("do not fit the others" in text and all(n in text for n in SPOILED) for text in told)
    ways = ("repair_poses", "--poses auto", "exclude_outlier_views")
    assert any(all(way in text for way in ways) for text in told)
    assert with_all["worst"] in SPOILED
    assert f"dB: {with_all['worst']}" in (tmp_path / "all" / "report.html").read_text()

    told = run(scene, tmp_path / "without", "exclude_outlier_views=true")
    without, better = measured(tmp_path / "without")
    assert without["left_out"] == SPOILED and len(without["views"]) == 26
    left = [text for text in told if text.startswith("From iteration ")]
    assert left and all(any(name in text for text in left) for name in SPOILED)
    assert not any("do not fit the others;" in text for text in told)  # they are not trained on any more
    assert better > psnr

    def stop_behind_it(events: list[Event]) -> bool:
        return any(isinstance(event, CheckpointWritten) and event.iteration == 100 for event in events)

    with pytest.raises(CancelledError):
        run(scene, tmp_path / "stopped", "exclude_outlier_views=true", should_stop=stop_behind_it)
    run(scene, tmp_path / "stopped", "exclude_outlier_views=true")
    for name in ("scene.ply", "renders/view_008.png"):
        assert (tmp_path / "stopped" / name).read_bytes() == (tmp_path / "without" / name).read_bytes()


def views_of(count: int) -> list[DatasetView]:
    """Views from random places that look along z."""
    places = np.random.default_rng(0).standard_normal((count, 3))
    return [
        DatasetView(f"{k}", 0, np.eye(3), -place, 8, 8, Path(f"{k}"), None) for k, place in enumerate(places)
    ]


def test_outlier_views_blockwise_matches_single_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    views, count = views_of(200), 200
    psnr = 30 + np.random.default_rng(1).standard_normal(count)
    psnr[[17, 140]] = 12
    fits = ViewPsnr(np.arange(count), psnr, psnr)
    at_once = find_outlier_views(fits, views, np.arange(count))
    assert sorted(at_once.tolist()) == [17, 140]
    monkeypatch.setattr(misfit_module, "MAX_DISTANCES", 1000)
    np.testing.assert_array_equal(find_outlier_views(fits, views, np.arange(count)), at_once)


@pytest.mark.exhaustive
def test_memory_grows_with_the_number_of_views_not_its_square() -> None:
    count = 5000
    views, psnr = views_of(count), np.full(count, 30.0)
    psnr[1234] = 12
    tracemalloc.start()
    found = find_outlier_views(ViewPsnr(np.arange(count), psnr, psnr), views, np.arange(count))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found.tolist() == [1234]
    assert peak < 400e6  # at once it would be 1.6 GB, and 16 times that for 20,000 views
