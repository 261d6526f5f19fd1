"""Requests that meet each other get an answer that fits, never a fault of the service."""

import asyncio
import uuid

import httpx
import pytest

from octasplat.service.actions import commits as actions
from octasplat.service.intake.dataset import DatasetSummary
from octasplat.service.state import Service
from octasplat.workers.queue.job_results import ResultFile
from tests.support.model_builder import photograph
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    committed_dataset,
    new_job,
    store_content,
)

ROUNDS = 12


async def new_dataset(http: httpx.AsyncClient) -> str:
    return str((await http.post("/v1/datasets", json={"name": "d"})).headers["Location"])


def statuses(answers: list[httpx.Response]) -> list[int]:
    return sorted(answer.status_code for answer in answers)


async def test_deletions_and_uploads_at_once(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        for _ in range(ROUNDS):
            dataset = await new_dataset(http)
            address = f"{dataset}/files/images/a.png"
            await http.put(address, content=photograph())
            requests = [
                http.delete(dataset),
                http.delete(dataset),
                http.put(f"{dataset}/files/images/b.png", content=photograph()),
                http.patch(dataset, json={"name": "e"}),
                http.delete(address),
            ]
            answers = await asyncio.gather(*requests)
            assert {answer.status_code for answer in answers} <= {200, 201, 204, 404, 409}, answers
            assert 204 in {answer.status_code for answer in answers}


async def test_dataset_deletion_during_check_is_refused(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        loop, begun, go_on = asyncio.get_running_loop(), asyncio.Event(), asyncio.Event()

        def check(*_: object) -> DatasetSummary:
            loop.call_soon_threadsafe(begun.set)
            asyncio.run_coroutine_threadsafe(go_on.wait(), loop).result(60)
            return DatasetSummary(photographs=3, pixels=1, size_bytes=1, masks=0, has_model=False)

        monkeypatch.setattr(actions, "check_dataset", check)
        commit = asyncio.create_task(http.post(f"{dataset}/commit"))
        await begun.wait()
        again = await http.post(f"{dataset}/commit", headers={"Prefer": "respond-async"})
        assert [(await http.delete(dataset)).status_code, again.status_code] == [409, 202]
        go_on.set()
        assert (await commit).status_code == 200
        assert (await http.delete(dataset)).status_code == 204


async def test_concurrent_job_deletions_succeed_once(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        for _ in range(ROUNDS):
            job = (await http.post("/v1/jobs", json={"dataset_id": dataset, "kind": "toy"})).json()
            address = f"/v1/jobs/{job['id']}"
            answers = await asyncio.gather(
                http.delete(address, params={"cancel": True}),
                http.delete(address, params={"cancel": True}),
                http.post(f"{address}/cancel"),
                http.patch(address, json={"label": "x"}),
            )
            assert {answer.status_code for answer in answers} <= {200, 202, 204, 404, 409}, answers
            again = await http.delete(address)
            assert again.status_code in (204, 404)


async def test_ranges_with_thousands_of_digits(
    connect_service: ConnectService, s3_address: str, s3_bucket: str
) -> None:
    async def conversation(http: httpx.AsyncClient, service: Service) -> None:
        dataset = await committed_dataset(service)
        job = (await http.post("/v1/jobs", json={"dataset_id": dataset, "kind": "toy"})).json()
        sha256 = store_content(service, b"0123456789")
        attempt = await claim_job(service, job)
        await attempt.succeed([ResultFile("a.bin", sha256, 10, "application/octet-stream")])
        address = f"/v1/jobs/{job['id']}/artifacts/a.bin"
        for asked in (f"bytes={'9' * 5000}-", f"bytes=-{'9' * 5000}", f"bytes=0-{'9' * 5000}"):
            answer = await http.get(address, headers={"Range": asked})
            assert answer.status_code in (200, 206, 400, 416)
        assert (await http.get(address, headers={"Range": "bytes=2-4"})).content == b"234"

    async with connect_service(storage=f"s3://{s3_bucket}/some?endpoint_url={s3_address}") as (http, service):
        await conversation(http, service)
    async with connect_service() as (http, service):
        await conversation(http, service)


async def test_retry_locks_blocks_before_their_job(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        await (await claim_job(service, job)).fail({"type": "x", "message": "x."})
        block = uuid.uuid4()
        async with service.pool.connection() as connection:
            await connection.execute(
                """
                INSERT INTO jobs (id, owner, kind, dataset_id, options, queue, state, root_id, role)
                SELECT %s, owner, kind, dataset_id, '{"number": 1}', queue, 'succeeded', id, 'block' FROM jobs
                WHERE id = %s
                """,
                [block, job["id"]],
            )
        lock = "SELECT id FROM jobs WHERE id = %s FOR UPDATE"
        async with service.pool.connection() as other, other.transaction():
            await other.execute(lock, [block])  # as a request to cancel the job does first
            retry = asyncio.create_task(http.post(f"/v1/jobs/{job['id']}/retry"))
            while not await is_waited_for(service, other.info.backend_pid):
                assert not retry.done(), (await retry).text
                await other.execute("SELECT pg_sleep(0.05)")
            await other.execute(f"{lock} NOWAIT", [job["id"]])
        answer = await retry
        assert answer.status_code == 202, answer.text


async def is_waited_for(service: Service, pid: int) -> bool:
    """Whether a process of the database waits for a lock of another."""
    async with service.pool.connection() as connection:
        query = "SELECT 1 FROM pg_stat_activity WHERE %s = ANY(pg_blocking_pids(pid))"
        return await (await connection.execute(query, [pid])).fetchone() is not None
