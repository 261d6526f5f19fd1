"""Renders whose images nearly fill the disk: each lies there once, and a render goes on or says why not."""

import asyncio
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import octasplat as osp
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.workers.db.connections import open_pool
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.storage.factory import open_storage
from octasplat.workers.storage.trees import store_tree
from octasplat.workers.worker.job_kinds import get_job_kind
from tests.support.shell_scene import shell_scene
from tests.support.small_disk import small_disk
from tests.support.worker_harness import WorkerHarness

MIB = 1 << 20
FRAMES = 24
RENDER = {"format": "exr", "frames": FRAMES, "width_px": 256, "height_px": 256}
MODULES = {"KIND_MODULES": '["tests.support.toy_kind", "tests.support.frequent_frames"]'}


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The images by their names among the results."""
    folder = tmp_path_factory.mktemp("images")
    write_gaussian_ply(shell_scene(), folder / "scene.ply")
    osp.render(folder / "scene.ply", folder / "views", mode="turntable", threads=1, **RENDER)
    return {f"views/{path.name}": path.read_bytes() for path in (folder / "views").glob("*.exr")}


@contextmanager
def bench_on_disk(conninfo: str, folder: Path, size_bytes: int) -> Iterator[WorkerHarness]:
    """Workers whose store and work lie on one disk."""
    with small_disk(folder, -(-size_bytes // MIB)) as disk:
        bench = WorkerHarness(conninfo, disk, stale_seconds=2.0)
        try:
            yield bench
        finally:
            bench.close()


def submit_render(bench: WorkerHarness, scene: Path, disk_bytes: int) -> uuid.UUID:
    """Queue a render of a scene, which is the result of a job that succeeded."""
    scene.mkdir()
    write_gaussian_ply(shell_scene(), scene / "scene.ply")
    manifest = store_tree(open_storage(bench.folder / "store", floor_bytes=0), scene)
    results = [ResultFile(f.path, f.sha256, f.size_bytes, "text/plain") for f in manifest.files]
    source = bench.job(bench.submit(queue="elsewhere"))

    async def succeed() -> None:
        async with open_pool(bench.conninfo, max_size=2) as pool:
            assert source.slip is not None
            attempt = await claim(pool, source.id, source.slip, "elsewhere")
            assert attempt is not None
            await attempt.succeed(results)

    asyncio.run(succeed())
    options = get_job_kind("render").resolve(RENDER).model_dump(mode="json")
    return bench.submit("render", source_id=source.id, options=options, estimate={"disk_bytes": disk_bytes})


@pytest.mark.exhaustive
def test_killed_render_goes_on_from_images_that_lie_on_disk_once(
    conninfo: str, tmp_path: Path, expected: dict[str, bytes]
) -> None:
    total = sum(map(len, expected.values()))
    with bench_on_disk(conninfo, tmp_path / "disk", total * 3 // 2 + 3 * MIB) as bench:
        job_id = submit_render(bench, tmp_path / "scene", total * 3 // 4)
        first = bench.worker(FULL_DISK_SECONDS="0.2", **MODULES)
        job = bench.wait(job_id, lambda job: (job.checkpoint or {}).get("step", 0) >= FRAMES // 2)
        first.kill()
        bench.worker(FULL_DISK_SECONDS="0.2", **MODULES)
        job = bench.wait_until_finished(job_id)
        assert job.state == "succeeded", (job.error, bench.log(job_id))
        assert [event.data["stage"] for event in bench.events(job_id) if event.kind == "resumed"] == [
            "render"
        ]
        assert bench.results(job_id) == expected


@pytest.mark.exhaustive
def test_render_that_fills_disk_fails_and_lets_others_go_on(
    conninfo: str, tmp_path: Path, expected: dict[str, bytes]
) -> None:
    total = sum(map(len, expected.values()))
    with bench_on_disk(conninfo, tmp_path / "disk", total * 3 // 4 + 2 * MIB) as bench:
        bench.worker(FLOOR_BYTES=str(2 * MIB), FULL_DISK_SECONDS="0.2", **MODULES)
        job_id = submit_render(bench, tmp_path / "scene", total // 4)
        job = bench.wait_until_finished(job_id)
        assert job.state == "failed" and job.error is not None, job
        assert job.error["type"] == "no_space" and "bytes" in job.error["message"], job.error
        other = bench.wait_until_finished(bench.submit(options={"steps": 3}))
        assert other.state == "succeeded"
