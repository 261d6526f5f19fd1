"""A training that begins with the Gaussians of another job: from its result, or from where it was stopped."""

import json
import os
import signal
import uuid
from pathlib import Path
from typing import Any

import pytest

from octasplat.engine.pipeline import reconstruct
from octasplat.engine.runs.config import resolve_config
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.jobs import delete_job
from octasplat.workers.storage.factory import open_storage
from octasplat.workers.storage.trees import TreeFile, fetch_tree
from tests.support.stored_dataset import store_dataset
from tests.support.tiny_dataset import make_tiny_dataset
from tests.support.worker_harness import WorkerHarness, child_pids

pytestmark = pytest.mark.heavy

MAX_WAIT_SECONDS = 1200.0
TRAIN: dict[str, Any] = {
    "iterations": 80,
    "rays_per_batch": 512,
    "sh_degree": 1,
    "max_gaussians": 400,
    "initial_points": 300,
    "probe_rays": 256,
    "rebuild_every": 10,
    "checkpoint_every": 20,
    "exposure": False,
    "early_stopping_db": 0,
}
UNCHANGED = {
    **TRAIN,
    "iterations": 1,
    "lr": dict.fromkeys(("mean", "quat", "log_scale", "opacity", "color"), 1e-9),
}
OTHER = {**TRAIN, "iterations": 120, "sh_degree": 0, "seed": 3}
SETTINGS = {"preset": "fast", "test_every": 4, "exports": []}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, samples_per_side=2, points=300)


@pytest.fixture(scope="module")
def dataset(bench_of_module: WorkerHarness, scene: Path) -> uuid.UUID:
    return store_dataset(bench_of_module, scene)


@pytest.fixture(scope="module")
def finished(bench_of_module: WorkerHarness, dataset: uuid.UUID) -> uuid.UUID:
    """A reconstruction that succeeded."""
    job = submit(bench_of_module, dataset, TRAIN)
    assert over(bench_of_module, job).state == "succeeded"
    return job


@pytest.fixture(scope="module")
def stopped(bench_of_module: WorkerHarness, dataset: uuid.UUID) -> uuid.UUID:
    """A reconstruction that was cancelled in the middle of its training."""
    job = submit(bench_of_module, dataset, {**TRAIN, "iterations": 900})
    return stop_at_checkpoint(bench_of_module, job)


def submit(
    bench: WorkerHarness, dataset: uuid.UUID, train: dict[str, Any], source: uuid.UUID | None = None
) -> uuid.UUID:
    begins = {} if source is None else {"begins_with_source": True}
    requested = {**SETTINGS, "train": train, **begins}
    options: dict[str, Any] = {}
    return bench.submit(
        "reconstruct", dataset_id=dataset, source_id=source, options=options, requested=requested
    )


def over(bench: WorkerHarness, job: uuid.UUID) -> Job:
    return bench.wait_until_finished(job, MAX_WAIT_SECONDS)


def stop_at_checkpoint(bench: WorkerHarness, job: uuid.UUID) -> uuid.UUID:
    bench.wait(job, lambda row: row.checkpoint is not None, MAX_WAIT_SECONDS)
    bench.cancel(job)
    assert over(bench, job).state == "canceled"
    return job


def psnr(bench: WorkerHarness, job: uuid.UUID) -> float:
    return float(json.loads(bench.results(job)["metrics.json"])["mean"]["psnr"])


def texts(bench: WorkerHarness, job: uuid.UUID) -> str:
    """All that is told of a job."""
    error = bench.job(job).error
    return "\n".join([bench.log(job), json.dumps(error), *(str(e.data) for e in bench.events(job))])


@pytest.mark.exhaustive
def test_training_begins_with_what_another_job_has_made(
    shared_bench: WorkerHarness, dataset: uuid.UUID, finished: uuid.UUID
) -> None:
    job = submit(shared_bench, dataset, UNCHANGED, finished)
    assert over(shared_bench, job).state == "succeeded", shared_bench.job(job).error
    # One iteration that changes nothing: from the sparse points it would be several dB less.
    assert abs(psnr(shared_bench, job) - psnr(shared_bench, finished)) < 0.05
    results = shared_bench.results(job)
    assert "scene.ply" in results
    assert not [name for name in results if name.startswith(("start/", "job "))]
    assert str(shared_bench.folder) not in texts(shared_bench, job)


@pytest.mark.exhaustive
def test_stopped_training_is_gone_on_with_to_the_same_bytes_after_a_kill(
    shared_bench: WorkerHarness, scene: Path, dataset: uuid.UUID, stopped: uuid.UUID, tmp_path: Path
) -> None:
    checkpoint = shared_bench.job(stopped).checkpoint
    assert checkpoint is not None and not shared_bench.results(stopped)
    files = [TreeFile.model_validate(file) for file in checkpoint["files"]]
    fetch_tree(open_storage(shared_bench.folder / "store"), files, tmp_path)
    given = {**{f"train.{name}": value for name, value in OTHER.items()}, "test_every": 4}
    config = resolve_config(
        "fast",
        settings={"exports": ()},
        assignments=[f"{name}={json.dumps(value)}" for name, value in given.items()],
    )
    whole = reconstruct(scene, tmp_path / "whole", config, threads=1, start_from=tmp_path / "run")

    job = submit(shared_bench, dataset, OTHER, stopped)
    shared_bench.wait(job, lambda row: row.checkpoint is not None or row.is_over, MAX_WAIT_SECONDS)
    if not shared_bench.job(job).is_over:
        for pid in child_pids(shared_bench.processes[0]):
            os.kill(pid, signal.SIGKILL)
    assert over(shared_bench, job).state == "succeeded", shared_bench.job(job).error
    results = shared_bench.results(job)
    assert results["scene.ply"] == (whole / "scene.ply").read_bytes()
    assert results["held_out.json"] == (whole / "held_out.json").read_bytes()
    kept = [event for event in shared_bench.events(job) if event.kind == "resumed"]
    assert kept and shared_bench.job(job).attempt > 1
    assert str(shared_bench.folder) not in texts(shared_bench, job)
    assert str(shared_bench.folder) not in results["events.jsonl"].decode()


@pytest.mark.exhaustive
def test_unsuitable_start_is_refused_with_the_name_of_its_job(
    shared_bench: WorkerHarness, dataset: uuid.UUID, stopped: uuid.UUID
) -> None:
    small = {**TRAIN, "max_gaussians": 50, "initial_points": 50}
    job = submit(shared_bench, dataset, small, stopped)
    failed = over(shared_bench, job)
    assert failed.state == "failed" and failed.error is not None
    message = failed.error["message"]
    assert message.startswith(f"job {stopped} has ") and "this run may have 50" in message, message


@pytest.mark.exhaustive
def test_training_goes_on_with_its_own_copy_of_what_is_gone(
    shared_bench: WorkerHarness, dataset: uuid.UUID, stopped: uuid.UUID
) -> None:
    job = submit(shared_bench, dataset, {**OTHER, "iterations": 900}, stopped)
    stop_at_checkpoint(shared_bench, job)
    paths = {file["path"] for file in (shared_bench.job(job).checkpoint or {})["files"]}
    assert {"run/start/start.json", "run/start/best.npz", "run/start/views.json"} <= paths

    kept = (shared_bench.job(stopped).checkpoint or {})["files"]
    (digest,) = (file["sha256"] for file in kept if "iteration_" in file["path"])
    open_storage(shared_bench.folder / "store").delete(digest)
    lost = over(shared_bench, submit(shared_bench, dataset, OTHER, stopped))
    assert lost.state == "failed" and lost.error is not None
    assert lost.error["message"].startswith(f"What job {stopped} has made is gone from the store")

    shared_bench.run_query(lambda connection: delete_job(connection, stopped))
    assert shared_bench.job(job).source_id is None
    before = (shared_bench.job(job).checkpoint or {})["step"]
    shared_bench.retry(job)
    shared_bench.wait(
        job, lambda row: row.is_over or (row.checkpoint or {})["step"] > before, MAX_WAIT_SECONDS
    )
    stop_at_checkpoint(shared_bench, job)
    # Without the copy the job fails, and does not begin with the sparse points.
    shared_bench.retry(job, fresh=True)
    failed = over(shared_bench, job)
    assert failed.state == "failed" and failed.error is not None
    assert failed.error["message"] == "The job that this one begins with was deleted; make a new job."
