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
