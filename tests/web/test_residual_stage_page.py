"""The page of a job with materials names the stage in which residual colors are fitted, and its time left."""

import json
import threading
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.workers.cli.main import cli
from tests.support.service_harness import TOKEN
from tests.support.web_harness import Browse, RunningService

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STAGES = ["load", "train", "residual", "evaluate", "export"]
SECONDS_AFTER = 70.0


def trained(iteration: int, seconds_left: float) -> dict[str, Any]:
    """The state of a training after ``iteration`` of 60; ``seconds_left`` holds the fit."""
    return {
        "kind": "training_progress", "iteration": iteration, "total_iterations": 60, "loss": 0.1,
        "psnr": 20.0, "gaussians": 300, "rays_per_second": 1e4, "hits_per_ray": 9.0, "seconds": 3.0,
        "seconds_left": seconds_left, "seconds_after": SECONDS_AFTER,
    }  # fmt: skip


def fitted(step: int) -> dict[str, Any]:
    return {"kind": "stage_progress", "stage": "residual", "step": step, "total_steps": 96, "part": 0.0}


@pytest.fixture(scope="module")
def job(service: RunningService, tmp_path_factory: pytest.TempPathFactory) -> uuid.UUID:
    """A job with materials that a worker has trained a half of."""
    root = tmp_path_factory.mktemp("fit")
    config = SyntheticDatasetConfig(views=4, width_px=32, height_px=24, samples_per_side=1, points=100)
    write_synthetic_dataset(root / "scene", config)
    command = ("submit", root / "scene", "--materials", "--queue", "nobody", "--server", service.url, "-q")
    done = CliRunner().invoke(cli, [str(part) for part in command], env={"OCTASPLAT_TOKEN": TOKEN})
    assert done.exit_code == 0, done.output
    job = uuid.UUID(done.stdout.strip().splitlines()[-1])
    events = [
        {"kind": "stage_started", "stage": "load", "total_steps": 0},
        {"kind": "stage_finished", "stage": "load", "seconds": 2.0},
        {"kind": "stage_started", "stage": "train", "total_steps": 60},
    ]
    (root / "events.jsonl").write_text("".join(f"{json.dumps(event)}\n" for event in events))
    service.worker.run(job, root, until=60)
    service.worker.show_progress(job, trained(30, 100.0), stage="train", seconds_left=30.0)
    return job


def test_page_names_the_fit_of_residual_colors_and_its_time(
    service: RunningService, browse: Browse, job: uuid.UUID, tmp_path: Path
) -> None:
    worker, is_over = service.worker, threading.Event()
    told: list[tuple[str, Callable[[], None]]] = [
        ("opened", lambda: worker.show_progress(job, trained(50, 85.0), stage="train", seconds_left=15.0)),
        ("trained", lambda: worker.begin_stage(job, "train", "residual", seconds=63.0, steps=96)),
        ("fits", lambda: worker.show_progress(job, fitted(40), stage="residual", seconds_left=8.0)),
    ]

    def tell() -> None:
        for signal, report in told:
            while not (tmp_path / signal).exists():  # what the page has seen so far
                if is_over.wait(0.05):
                    return
            report()

    teller = threading.Thread(target=tell)
    teller.start()
    try:
        found = browse("fit", service.url, job=str(job), signals=str(tmp_path))
    finally:
        is_over.set()
        teller.join()
    assert found["complaints"] == [] and found["faults"] == []
    assert [name for name, *_ in found["trained"]] == [name for name, *_ in found["fits"]] == STAGES
    assert [state for _, state, _ in found["trained"]] == ["done", "now", "later", "later", "later"]
    assert [state for _, state, _ in found["fits"]] == ["done", "done", "now", "later", "later"]
    assert found["fits"][2] == ["residual", "now", "step"] and found["bar"].startswith("residual 40/96")
    # told by events and by the status alike: the time of this stage, not of what follows
    bars = [text.strip() for text in found["bars"]]
    assert bars[:2] == ["train 30/60 · 30 s left", "train 50/60 · 15 s left"] and len(bars) == len(set(bars))
