"""How far a job is as a whole, from the estimated times of its stages."""

from types import SimpleNamespace
from typing import Any

import pytest

from octasplat.service.whole_progress import whole_progress


@pytest.mark.parametrize(
    ("seconds", "share", "seconds_left"),
    [
        ({"load": 10.0, "train": 30.0}, 0.625, 20.0),
        ({"load": 30.0, "train": 10.0}, 0.875, 20.0),
        ({"load": 0.0, "train": 10.0}, 0.5, 20.0),
        ({"load": 0.0, "train": 0.0}, 0.75, 20.0),
        ({"train": 10.0}, 0.75, 20.0),
    ],
)
def test_stages_are_weighed_by_estimated_times(
    seconds: dict[str, float], share: float, seconds_left: float
) -> None:
    job: Any = SimpleNamespace(
        state="running",
        is_over=False,
        stage="train",
        step=50,
        total_steps=100,
        seconds_left=20.0,
        estimate={"stage_seconds": seconds},
    )
    found = whole_progress(job, ["load", "train"])
    assert (found.share, found.seconds_left) == (share, seconds_left)


@pytest.mark.parametrize(
    ("stage", "step", "seconds_left", "whole_left"),
    [
        ("features", 50, 10.0, 10.0 + 2.0 * 500.0),  # half as fast as estimated
        ("features", 99, 2.0, 2.0 + 2.0 * 500.0),  # 20 times as slow: a noise of the last step
        ("features", 50, 0.1, 0.1 + 0.5 * 500.0),
        ("matches", 97, 585.0, 585.0 + 400.0),  # what the quick look has ruled out took no time
    ],
)
def test_stages_to_come_are_as_slow_as_this_one_within_reason(
    stage: str, step: int, seconds_left: float, whole_left: float
) -> None:
    job: Any = SimpleNamespace(
        state="running",
        is_over=False,
        stage=stage,
        step=step,
        total_steps=100,
        seconds_left=seconds_left,
        estimate={"stage_seconds": {"features": 10.0, "matches": 100.0, "train": 400.0}},
    )
    found = whole_progress(job, ["features", "matches", "train"])
    assert found.seconds_left == pytest.approx(whole_left)


@pytest.mark.parametrize(
    ("stage", "stages", "share"),
    [
        ("lenses", ["poses", "load", "train"], 0.75),  # of poses that were found
        ("check", ["load", "train"], 1 / 3),  # of given ones
        ("features", ["load", "train"], 1 / 3),
        (None, ["load", "train"], 0.0),
        ("lenses", ["edit"], 0.0),
    ],
)
def test_stages_that_nobody_expects_come_before_the_training(
    stage: str | None, stages: list[str], share: float
) -> None:
    job: Any = SimpleNamespace(
        state="running",
        is_over=False,
        stage=stage,
        step=1,
        total_steps=4,
        seconds_left=5.0,
        estimate={"stage_seconds": {"poses": 50.0, "load": 10.0, "train": 20.0}},
    )
    found = whole_progress(job, stages)
    assert found.share == pytest.approx(share, abs=1e-4) and found.seconds_left is None


@pytest.mark.parametrize(
    ("seconds", "stages", "stage", "share", "left"),
    [
        ({"train": 30.0, "residual": 10.0}, ["train", "residual"], "train", 0.375, 25.0),
        ({"train": 30.0, "residual": 10.0}, ["train", "residual"], "residual", 0.875, 15.0),
        ({"train": 40.0}, ["train", "residual"], "train", 0.5, 15.0),  # estimated by a former version
        ({"train": 40.0, "evaluate": 10.0}, ["train", "evaluate"], "residual", 0.8, None),  # unexpected
    ],
)
def test_fit_of_residual_colors_counts(
    seconds: dict[str, float], stages: list[str], stage: str, share: float, left: float | None
) -> None:
    job: Any = SimpleNamespace(
        state="running",
        is_over=False,
        stage=stage,
        step=50,
        total_steps=100,
        seconds_left=15.0,
        estimate={"stage_seconds": seconds},
    )
    found = whole_progress(job, stages)
    assert (found.share, found.seconds_left) == (share, left)
