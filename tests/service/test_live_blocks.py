"""While blocks are trained their job shows the coarse scene, and what each has learnt once it is done."""

import asyncio
import uuid
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.service.live_scene_file import KeptRows
from octasplat.service.state import Service
from octasplat.workers.db.live_scenes import LiveScene
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.storage_leases import storage_lease
from tests.service.test_block_views import job_in_blocks, read
from tests.support.service_harness import ConnectService, claim_job, store_content

COARSE = np.arange(12, dtype=np.float32).reshape(4, 3)
"""Positions of the coarse Gaussians, of which three are in the first block and one in the second."""
LEARNT = {1: COARSE[:2] + 100, 2: np.concatenate([COARSE, COARSE]) + 200}
CAMERAS = b'{"cameras": [], "views": []}'


def ply(folder: Path, positions: np.ndarray, degree: int = 0) -> bytes:
    """A file with Gaussians at these places."""
    count = len(positions)
    gaussians = FlatGaussians(
        means_world=positions,
        quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        log_scales=np.zeros((count, 2), np.float32),
        opacity_logits=np.zeros(count, np.float32),
        sh=np.zeros((count, (degree + 1) ** 2, 3), np.float32),
    )
    write_gaussian_ply(gaussians, folder / "some.ply")
    return (folder / "some.ply").read_bytes()


async def show(
    service: Service,
    attempt: Attempt,
    content: bytes,
    step: int,
    gaussians: int,
    counts: list[int] | None = None,
) -> str:
    """Record a state of a training as its worker does; the digest of the file."""
    async with storage_lease(service.pool, service.storage) as lease:
        digest, views = store_content(service, content), store_content(service, CAMERAS)
        scene = LiveScene(attempt.job.id, digest, views, step, gaussians, counts)
        await attempt.record_live_scene(scene, lease)
    return digest


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path


async def begin(
    http: httpx.AsyncClient, service: Service, folder: Path
) -> tuple[dict[str, Any], list[Attempt], list[str]]:
    """A job that shows its coarse scene, the attempts at its blocks, and the digests of all they show."""
    coarse = ply(folder, COARSE)
    digests: list[str] = []

    async def show_coarse(attempt: Attempt) -> None:
        digests.append(await show(service, attempt, coarse, 5, 4, [3, 1]))

    job = await job_in_blocks(http, service, before_blocks=show_coarse, kind="reconstruct", options={})
    attempts = [await claim_job(service, block) for block in (await read(http, job))["blocks"]]
    for number, attempt in enumerate(attempts, start=1):
        learnt = ply(folder, LEARNT[number])
        digests.append(await show(service, attempt, learnt, 10, len(LEARNT[number])))
    return job, attempts, digests


async def shown(http: httpx.AsyncClient, job: dict[str, Any], folder: Path) -> np.ndarray:
    """Positions of the Gaussians that the page shows."""
    answer = await http.get(f"/v1/jobs/{job['id']}/live-scene")
    assert answer.status_code == 200, answer.text
    (folder / "shown.ply").write_bytes(answer.content)
    tag = {"If-None-Match": answer.headers["ETag"]}
    assert (await http.get(f"/v1/jobs/{job['id']}/live-scene", headers=tag)).status_code == 304
    positions: np.ndarray = read_gaussian_ply(folder / "shown.ply")[0].means_world
    return positions


async def live_events(http: httpx.AsyncClient, job: dict[str, Any]) -> list[tuple[int, int]]:
    timeline = (await http.get(f"/v1/jobs/{job['id']}/timeline")).json()["events"]
    found = [event["data"] for event in timeline if event["kind"] == "live_scene"]
    return [(data["step"], data["gaussians"]) for data in found]


async def test_trained_block_is_shown_in_the_place_of_its_coarse_gaussians(
    connect_service: ConnectService, folder: Path
) -> None:
    async with connect_service() as (http, service):
        job, (first, second), _ = await begin(http, service, folder)
        np.testing.assert_array_equal(await shown(http, job, folder), COARSE)
        await second.succeed([], job_queue=service.job_queue)
        expected = np.concatenate([COARSE[:3], LEARNT[2]])
        np.testing.assert_array_equal(await shown(http, job, folder), expected)
        assert await live_events(http, job) == [(5, 4), (5 + 10, 3 + 8)]
        assert "Step 15, 11 Gaussians" in (await http.get(f"/jobs/{job['id']}")).text
        await first.succeed([], job_queue=service.job_queue)
        expected = np.concatenate([LEARNT[1], LEARNT[2]])
        np.testing.assert_array_equal(await shown(http, job, folder), expected)
        # The merge shows a state of its own, and nothing is left of the blocks' when it is done.
        merge = await claim_job(service, job)
        np.testing.assert_array_equal(await shown(http, job, folder), expected)
        await show(service, merge, ply(folder, COARSE + 300), 36, 4)
        np.testing.assert_array_equal(await shown(http, job, folder), COARSE + 300)
        assert await live_events(http, job) == [(5, 4), (15, 11), (35, 10), (36, 4)]
        await merge.succeed([], job_queue=service.job_queue)
        assert (await http.get(f"/v1/jobs/{job['id']}/live-scene")).status_code == 404
        async with service.pool.connection() as connection:
            cursor = await connection.execute("SELECT count(*) AS n FROM live_scenes")
            assert await cursor.fetchone() == {"n": 0}


async def test_state_of_a_former_version_is_not_taken_for_that_of_blocks(
    connect_service: ConnectService, folder: Path
) -> None:
    async with connect_service() as (http, service):
        job, attempts, _ = await begin(http, service, folder)
        for attempt in attempts:
            await attempt.succeed([], job_queue=service.job_queue)
        merge = await claim_job(service, job)
        column = "SELECT block_gaussians FROM live_scenes WHERE job_id = %s"
        async with service.pool.connection() as connection:
            row = await (await connection.execute(column, [job["id"]])).fetchone()
        assert row is not None
        # As many Gaussians as the coarse file has; such a worker does not know the column and leaves it.
        await show(service, merge, ply(folder, COARSE + 300), 36, 4)
        async with service.pool.connection() as connection:
            await connection.execute(
                "UPDATE live_scenes SET block_gaussians = %s WHERE job_id = %s",
                [row["block_gaussians"], job["id"]],
            )
        np.testing.assert_array_equal(await shown(http, job, folder), COARSE + 300)


async def test_blocks_that_end_at_once_are_both_shown(connect_service: ConnectService, folder: Path) -> None:
    async with connect_service() as (http, service):
        job, attempts, _ = await begin(http, service, folder)
        await asyncio.gather(*(attempt.succeed([], job_queue=service.job_queue) for attempt in attempts))
        expected = np.concatenate([LEARNT[1], LEARNT[2]])
        np.testing.assert_array_equal(await shown(http, job, folder), expected)
        assert (await live_events(http, job))[-1] == (35, 10)


@pytest.mark.parametrize("damage", ["gone", "damaged", "other columns", "other length"])
async def test_lost_file_of_a_block_leaves_its_coarse_gaussians(
    connect_service: ConnectService, folder: Path, damage: str
) -> None:
    async with connect_service() as (http, service):
        job, (first, second), digests = await begin(http, service, folder)
        if damage == "gone":
            service.storage.delete(digests[1])
        elif damage == "damaged":
            path = service.storage.local_path(digests[1])
            assert path is not None
            path.chmod(0o600)
            path.write_bytes(path.read_bytes()[:-1] + b"x")
        elif damage == "other columns":
            await show(service, first, ply(folder, LEARNT[1], degree=1), 10, 2)
        else:
            await show(service, first, ply(folder, LEARNT[1]), 10, 3)
        for attempt in (first, second):
            await attempt.succeed([], job_queue=service.job_queue)
        expected = np.concatenate([COARSE[:3], LEARNT[2]])
        np.testing.assert_array_equal(await shown(http, job, folder), expected)
        assert (await http.get(f"/jobs/{job['id']}")).status_code == 200


async def test_lost_coarse_scene_leaves_what_blocks_have_learnt(
    connect_service: ConnectService, folder: Path
) -> None:
    async with connect_service() as (http, service):
        job, (first, second), digests = await begin(http, service, folder)
        service.storage.delete(digests[0])
        address = f"/v1/jobs/{job['id']}/live-scene"
        assert (await http.get(address)).status_code == 410
        await first.succeed([], job_queue=service.job_queue)
        np.testing.assert_array_equal(await shown(http, job, folder), LEARNT[1])
        service.storage.delete(digests[1])
        np.testing.assert_array_equal(await shown(http, job, folder), LEARNT[1])  # kept since it was read
        service.live_rows = KeptRows()
        assert (await http.get(address)).status_code == 410
        assert (await http.get(f"/jobs/{job['id']}")).status_code == 200
        await second.succeed([], job_queue=service.job_queue)
        np.testing.assert_array_equal(await shown(http, job, folder), LEARNT[2])


async def test_block_that_is_trained_again_is_coarse_until_then(
    connect_service: ConnectService, folder: Path
) -> None:
    async with connect_service() as (http, service):
        job, (first, _), _ = await begin(http, service, folder)
        await first.succeed([], job_queue=service.job_queue)
        assert len(await shown(http, job, folder)) == 3
        async with service.pool.connection() as connection:
            await connection.execute("UPDATE jobs SET state = 'failed' WHERE id = %s", [first.job.id])
        np.testing.assert_array_equal(await shown(http, job, folder), COARSE)


async def test_file_that_a_former_worker_has_written_is_shown_as_it_is(
    connect_service: ConnectService, folder: Path
) -> None:
    async with connect_service() as (http, service):
        job, (first, _), _ = await begin(http, service, folder)
        await first.succeed([], job_queue=service.job_queue)
        digest = store_content(service, ply(folder, COARSE[:1] + 400))
        async with service.pool.connection() as connection:
            await connection.execute(
                "UPDATE live_scenes SET sha256 = %s, gaussians = 1 WHERE job_id = %s",
                [digest, uuid.UUID(job["id"])],
            )
        np.testing.assert_array_equal(await shown(http, job, folder), COARSE[:1] + 400)
