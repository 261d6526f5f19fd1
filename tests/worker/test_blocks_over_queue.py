"""A scene in blocks over the queue has the bytes of a run in one process, also after a worker is killed."""

import json
import signal
import uuid
from pathlib import Path
from typing import Any

import pytest

from octasplat.engine.pipeline import BlockRequest, reconstruct
from octasplat.engine.runs.config import resolve_config
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.block_jobs import blocks_of
from octasplat.workers.storage.factory import open_storage
from tests.support.stored_dataset import store_dataset
from tests.support.tiny_dataset import make_tiny_dataset
from tests.support.worker_harness import WorkerHarness

pytestmark = pytest.mark.heavy

MAX_WAIT_SECONDS = 1200.0
"""Several trainings follow each other, each in a process that begins anew."""

TRAIN = {
    "iterations": 30,
    "rays_per_batch": 512,
    "sh_degree": 1,
    "max_gaussians": 600,
    "initial_points": 300,
    "probe_rays": 256,
    "checkpoint_every": 10,
    "background": "learnt",
    "exposure": True,
}
SETTINGS = {"test_every": 4, "exports": ["mesh.ply"]}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, views=10, width_px=64, height_px=48)


@pytest.fixture(scope="module")
def one_process(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of one process."""
    given = {**{f"train.{name}": value for name, value in TRAIN.items()}, **SETTINGS}
    config = resolve_config(assignments=[f"{name}={json.dumps(value)}" for name, value in given.items()])
    output = tmp_path_factory.mktemp("whole") / "run"
    return reconstruct(scene, output, config, threads=1, blocks=BlockRequest(count=2))


def submit(bench: WorkerHarness, scene: Path, **options: Any) -> uuid.UUID:
    given = {"train": TRAIN, **SETTINGS, **options}
    return bench.submit("reconstruct", dataset_id=store_dataset(bench, scene), options={}, requested=given)


def blocks(bench: WorkerHarness, root: uuid.UUID) -> list[Job]:
    found: list[Job] = bench.run_query(lambda c: blocks_of(c, [root]))
    return found


def check_results(bench: WorkerHarness, root: uuid.UUID, whole: Path) -> None:
    job = bench.job(root)
    assert job.state == "succeeded", job.error
    results = bench.results(root)
    same = ("scene.ply", "mesh.ply", "background.exr", "held_out.json", "views.json")
    assert {name: results[name] == (whole / name).read_bytes() for name in same} == dict.fromkeys(same, True)
    renders = {name: content for name, content in results.items() if name.startswith("renders/")}
    assert renders and all((whole / name).read_bytes() == content for name, content in renders.items())
    record = json.loads(results["training.json"])
    alone = json.loads((whole / "training.json").read_text())
    assert list(record["pieces"]) == ["coarse", "block_001", "block_002", "finish"]
    assert record["iterations"] == alone["iterations"] and record["exposures"] == alone["exposures"]
    assert not any(name.startswith("blocks/") for name in results)


@pytest.mark.exhaustive
def test_one_worker_makes_the_bytes_of_one_process(
    bench: WorkerHarness, scene: Path, one_process: Path
) -> None:
    bench.worker()
    root = submit(bench, scene, blocks=2)
    bench.wait_until_finished(root, MAX_WAIT_SECONDS)
    check_results(bench, root, one_process)
    assert [child.attempt for child in blocks(bench, root)] == [1, 1] and bench.job(root).attempt == 2
    # The coarse scene was shown, and then what each block had learnt.
    shown = [event.data["step"] for event in bench.events(root) if event.kind == "live_scene"]
    assert shown[-3:] == [15, 15 + 15, 15 + 2 * 15]


@pytest.mark.exhaustive
def test_two_workers_of_which_one_is_killed_make_the_same_bytes(
    bench: WorkerHarness, scene: Path, one_process: Path
) -> None:
    soon: dict[str, Any] = {"STALE_SECONDS": "15"}
    workers = {name: bench.worker(name=name, **soon) for name in ("first", "second")}
    root = submit(bench, scene, blocks=2)
    bench.wait(root, lambda _: any(child.checkpoint and child.worker for child in blocks(bench, root)))
    busy = next(child for child in blocks(bench, root) if child.checkpoint and child.worker)
    assert busy.worker is not None
    workers[busy.worker].send_signal(signal.SIGKILL)
    bench.wait_until_finished(root, MAX_WAIT_SECONDS)
    check_results(bench, root, one_process)


@pytest.mark.exhaustive
def test_automatic_blocks_of_a_small_scene_are_no_blocks(bench: WorkerHarness, scene: Path) -> None:
    bench.worker()
    root = submit(bench, scene, blocks="auto")
    job = bench.wait_until_finished(root, MAX_WAIT_SECONDS)
    assert (job.state, job.attempt, job.role) == ("succeeded", 1, None)
    assert "scene.ply" in bench.results(root)


@pytest.mark.exhaustive
def test_block_that_the_store_lost_fails_the_job_by_name(bench: WorkerHarness, scene: Path) -> None:
    bench.worker()
    root = submit(bench, scene, blocks=2)
    bench.wait(root, lambda job: job.checkpoint is not None and job.role == "root")
    files = (bench.job(root).checkpoint or {})["files"]
    (plan,) = (file["sha256"] for file in files if file["path"].endswith("plan.npz"))
    open_storage(bench.folder / "store").delete(plan)
    job = bench.wait_until_finished(root, MAX_WAIT_SECONDS)
    assert job.state == "failed" and job.error is not None
    assert job.error["message"].startswith("Block ")
    assert "run/blocks/plan.npz" in job.error["message"] and "from the start" in job.error["message"]
