"""A scene in blocks on two hosts that share a database and an S3 store only, of which one dies for good."""

import json
from pathlib import Path

import pytest

from octasplat.engine.pipeline import BlockRequest, reconstruct
from octasplat.workers.db.live_scenes import get_shown_scene
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.block_jobs import blocks_of
from octasplat.workers.worker.dataset_folder import FILLED_BY_NEED
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.reconstruct_kinds import ReconstructJobConfig
from tests.support.stored_dataset import store_dataset
from tests.support.two_hosts import Hosts, two
from tests.support.wall_dataset import make_wall_dataset
from tests.support.worker_harness import kill_tree

__all__ = ["two"]

pytestmark = pytest.mark.heavy

MAX_WAIT_SECONDS = 1200.0
"""Several trainings follow each other, each in a process that begins anew."""
TRAIN = {
    **{"iterations": 240, "rays_per_batch": 256, "sh_degree": 1, "max_gaussians": 600, "initial_points": 300},
    **{"probe_rays": 256, "checkpoint_every": 10, "background": "learnt"},
}
REQUESTED = {"train": TRAIN, "test_every": 4, "exports": ["mesh.ply"], "blocks": 2}
HOSTS = ("host0", "host1")
SHOWN = {1: {1, 2, 3, 5, 6, 7, 9, 10}, 2: {6, 7, 9, 10, 11, 13, 14, 15}}
"""Photographs of the wall that train each block."""


@pytest.mark.exhaustive
def test_block_job_is_completed_by_the_host_that_lives(two: Hosts, tmp_path: Path) -> None:
    scene = make_wall_dataset(tmp_path / "wall")
    complete = get_job_kind("reconstruct").resolve(REQUESTED)
    assert isinstance(complete, ReconstructJobConfig)
    config = complete.run_config()
    alone = reconstruct(scene, tmp_path / "alone", config, threads=1, blocks=BlockRequest(count=2))
    bench = two.bench
    workers = [two.worker(0), two.worker(1)]
    for name in HOSTS:  # so that neither takes both blocks while the other one starts
        bench.wait_until_up(name)
    dataset_id = store_dataset(bench, scene)
    root = bench.submit("reconstruct", dataset_id=dataset_id, requested=REQUESTED)

    def blocks() -> list[Job]:
        found: list[Job] = bench.run_query(lambda c: blocks_of(c, [root]))
        return found

    planner = bench.wait(root, lambda job: job.worker is not None, MAX_WAIT_SECONDS).worker
    assert planner is not None
    first = HOSTS.index(planner)
    second = 1 - first

    def are_trained(job: Job) -> bool:
        found = blocks()
        return job.is_over or ({b.worker for b in found} == set(HOSTS) and all(b.checkpoint for b in found))

    assert not bench.wait(root, are_trained, MAX_WAIT_SECONDS).is_over
    # The host that did not plan has the photographs of its block, and no others.
    busy = {block.worker: block for block in blocks()}
    (place,) = (two.data(second) / "work" / "datasets" / f"{dataset_id}{FILLED_BY_NEED}").glob("[!.]*/images")
    there = {int(path.stem) for path in place.iterdir() if path.stat().st_size}
    assert there == SHOWN[busy[HOSTS[second]].options["number"]] and len(list(place.iterdir())) == 16

    # The coarse scene is what the job shows meanwhile.
    shown = bench.run_query(lambda c: get_shown_scene(c, root))
    assert shown is not None and shown.scene.step == 120

    two.found[first].disconnect()
    kill_tree(workers[first])
    job = bench.wait_until_finished(root, MAX_WAIT_SECONDS)
    assert (job.state, job.error, job.worker) == ("succeeded", None, HOSTS[second])
    lost = blocks()[busy[HOSTS[first]].options["number"] - 1]
    assert (lost.worker, lost.attempt) == (HOSTS[second], 2)
    assert [event.kind for event in bench.events(lost.id)].count("resumed") == 1
    results = bench.results(root)
    for name in ("scene.ply", "mesh.ply", "background.exr", "held_out.json", "views.json"):
        assert results[name] == (alone / name).read_bytes(), name
    assert list(json.loads(results["training.json"])["pieces"]) == [
        "coarse", "block_001", "block_002", "finish",
    ]  # fmt: skip
