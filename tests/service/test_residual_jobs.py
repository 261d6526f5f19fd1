"""A job with materials on a real service: cancelled while residual colors are fitted, and retried."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from test_reconstruction import TRAIN, Machine, start

from octasplat.engine.operations.reconstruct import options_from_json
from octasplat.engine.pipeline import reconstruct
from octasplat.workers.client.download import download_results
from octasplat.workers.client.submission import Submission, submit
from tests.support.tiny_dataset import make_tiny_dataset

pytestmark = [pytest.mark.heavy, pytest.mark.exhaustive]

STEPS = 60
MATERIALS = {"environment_height": 16, "ambient_occlusion_rays": 4, "residual_share": 10, "fallback": False}
OPTIONS: dict[str, Any] = {
    "preset": "fast",
    "materials": True,
    "exports": [],
    "train": {**TRAIN, "iterations": STEPS, "materials": MATERIALS},
}
STAGES = ["load", "train", "residual", "evaluate", "export"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, width_px=48, height_px=36, points=500)


@pytest.fixture(scope="module")
def machine(short_root: Path) -> Iterator[Machine]:
    machine = start(short_root / "residual")
    yield machine
    machine.stop()


def test_job_cancelled_in_the_fit_keeps_its_training_and_ends_with_the_same_bytes(
    machine: Machine, scene: Path, tmp_path: Path
) -> None:
    with machine.api as api:
        made = submit(api, Submission(scene, OPTIONS))
        address = f"/v1/jobs/{made['id']}"
        assert made["stages"] == STAGES

        def until(ready: Callable[[dict[str, Any]], bool], seconds: float = 300.0) -> dict[str, Any]:
            deadline = time.monotonic() + seconds
            while not ready(now := api.get(address)):
                assert time.monotonic() < deadline, now
                time.sleep(0.02)
            found: dict[str, Any] = now
            return found

        def stages(attempt: int, kind: str) -> list[str]:
            events = api.get(f"{address}/timeline", limit=5000)["events"]
            return [e["data"]["stage"] for e in events if e["kind"] == kind and e["attempt"] == attempt]

        fitting = until(
            lambda job: (job["stage"] == "residual" and job["step"] > 0) or job["state"] == "failed"
        )
        assert fitting["state"] == "running", fitting
        assert fitting["total_steps"] >= 10 * STEPS and 0 < fitting["progress"] < 1
        api.request("POST", f"{address}/cancel")
        cancelled = until(lambda job: job["state"] not in ("running", "canceling"))
        assert (cancelled["state"], cancelled["stage"], cancelled["error"]) == ("canceled", "residual", None)
        assert cancelled["checkpoint"] == {"stage": "train", "step": STEPS}
        assert api.get(f"{address}/artifacts")["artifacts"] == []  # there is no scene before the fit
        assert stages(1, "stage_started") == ["load", "train", "residual"]
        assert stages(1, "stage_finished") == ["load", "train"]
        log = "\n".join(line["text"] for line in api.get(f"{address}/logs")["lines"])
        assert "Fitting residual colors" in log and "Fitted residual colors" not in log

        api.request("POST", f"{address}/retry")
        done = until(lambda job: job["state"] not in ("queued", "running"))
        assert (done["state"], done["attempt"]) == ("succeeded", 2), done
        assert stages(2, "stage_finished") == STAGES
        events = api.get(f"{address}/timeline", limit=5000)["events"]
        [resumed] = [e["data"] for e in events if e["kind"] == "resumed"]
        assert (resumed["stage"], resumed["step"]) == ("train", STEPS)
        trained = [e for e in events if e["attempt"] == 2 and "iteration" in e["data"]]
        assert not trained  # nothing of the training was done again
        download_results(api, made["id"], tmp_path / "result")
    whole = reconstruct(scene, tmp_path / "whole", options_from_json(OPTIONS).config(), threads=1)
    for name in ("scene.ply", "residual.npz", "environment.exr"):
        assert (tmp_path / "result" / name).read_bytes() == (whole / name).read_bytes(), name
