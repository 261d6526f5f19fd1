"""Requests about things that others change, delete or lose at the same time."""

import asyncio
import logging
import uuid
from typing import Any

import httpx
import psycopg
import pytest
from test_uploads import repr_digest

from octasplat.engine.core.errors import ConfigError
from octasplat.service.actions.submission import submit_job
from octasplat.service.auth import Principal
from octasplat.service.schemas.jobs import NewJob
from octasplat.service.settings import ServiceSettings
from octasplat.service.state import Service
from octasplat.workers.db import datasets as rows
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.queue.jobs import get_job
from octasplat.workers.settings import load_settings
from tests.support.model_builder import photograph
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    committed_dataset,
    store_content,
)
from tests.support.zip_builder import ZipMember, build_zip

TOY = {"kind": "toy", "options": {"steps": 1}}


async def new_job(http: httpx.AsyncClient, **body: Any) -> dict[str, Any]:
    answer = await http.post("/v1/jobs", json={**TOY, **body})
    assert answer.status_code in (201, 202), answer.text
    made: dict[str, Any] = answer.json()
    return made


def result(service: Service, content: bytes, name: str = "scene.ply") -> ResultFile:
    return ResultFile(name, store_content(service, content), len(content), "application/octet-stream")


async def test_requests_of_one_owner_with_a_quota_do_not_stop_each_other(
    connect_service: ConnectService,
) -> None:
    async with connect_service(quota_bytes=1 << 30, quota_jobs=1000, quota_datasets=1000) as (http, service):
        shared = await committed_dataset(service)
        source = await new_job(http, dataset_id=shared)
        await (await claim_job(service, source)).succeed([result(service, b"ply")])
        failed = await new_job(http, dataset_id=shared)
        export = {"kind": "export", "source_id": source["id"], "options": {"files": ["a.glb"]}}
        answers: list[httpx.Response] = []
        for number in range(10):
            await (await claim_job(service, failed)).fail({"type": "x", "message": "x"})
            dataset = (await http.post("/v1/datasets", json={"name": "d"})).headers["Location"]
            address = f"{dataset}/files/images/a.png"
            answers += await asyncio.gather(
                http.post("/v1/jobs", json=export),
                http.post("/v1/jobs", json={**TOY, "dataset_id": shared}),
                http.post(f"/v1/jobs/{failed['id']}/retry", json={"from": "start"}),
                http.put(address, content=photograph()),
                http.post("/v1/datasets", json={"name": f"e{number}"}),
                http.delete(dataset),
                http.patch(f"/v1/datasets/{shared}", json={"name": f"n{number}"}),
                http.post("/v1/jobs", json={**TOY, "dataset_id": shared}),
            )
        assert {answer.status_code for answer in answers} <= {200, 201, 202, 204, 404, 409}, [
            answer.text for answer in answers if answer.status_code not in (200, 201, 202, 204)
        ]


async def test_downloads_are_revalidated(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, dataset_id=await committed_dataset(service))
        address = f"/v1/jobs/{job['id']}/artifacts/scene.ply"
        error = {"type": "x", "message": "x"}
        await (await claim_job(service, job)).fail(error, [result(service, b"old")])
        old = await http.get(address)
        assert old.content == b"old" and old.headers["Cache-Control"] == "private, no-cache"
        seen = {"If-None-Match": old.headers["ETag"]}
        assert (await http.get(address, headers=seen)).status_code == 304
        assert (await http.post(f"/v1/jobs/{job['id']}/retry", json={})).status_code in (200, 202)
        await (await claim_job(service, job)).succeed([result(service, b"new")])
        new = await http.get(address, headers=seen)
        assert (new.status_code, new.content) == (200, b"new")


async def test_lost_content_is_restored_by_new_upload(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = (await http.post("/v1/datasets", json={"name": "d"})).headers["Location"]
        address, content = f"{dataset}/files/images/a.png", photograph()
        file = (await http.put(address, content=content)).json()
        headers = repr_digest(content)
        assert (await http.put(address, content=content, headers=headers)).status_code == 200
        path = service.storage.local_path(file["sha256"])
        assert path is not None
        for harm in (path.unlink, lambda: (path.unlink(), path.write_bytes(content[:-3]))):
            harm()
            assert (await http.put(address, content=content, headers=headers)).status_code == 201
            assert (await http.get(address)).content == content
        assert (await http.put(address, content=content, headers=headers)).status_code == 200


async def test_retry_after_source_deletion_is_refused(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        source = await new_job(http, dataset_id=await committed_dataset(service))
        await (await claim_job(service, source)).succeed([result(service, b"ply")])
        job = await new_job(http, kind="export", source_id=source["id"], options={"files": ["a.glb"]})
        await (await claim_job(service, job)).fail({"type": "x", "message": "x"})
        assert (await http.delete(f"/v1/jobs/{source['id']}")).status_code == 204
        answer = await http.post(f"/v1/jobs/{job['id']}/retry", json={})
        assert answer.status_code == 409 and "was deleted" in answer.json()["detail"]
        assert (await http.get(f"/v1/jobs/{job['id']}")).json()["state"] == "failed"


async def test_same_content_under_second_name_counts_once(connect_service: ConnectService) -> None:
    content = photograph()

    async with connect_service(quota_bytes=len(content) + 4) as (http, _):
        dataset = (await http.post("/v1/datasets", json={"name": "d"})).headers["Location"]
        headers = repr_digest(content)
        answers = [
            await http.put(f"{dataset}/files/images/{name}.png", content=content, headers=headers)
            for name in ("a", "b")
        ]
        assert [answer.status_code for answer in answers] == [201, 201]
        other = photograph(33)
        answer = await http.put(f"{dataset}/files/images/c.png", content=other, headers=repr_digest(other))
        assert answer.status_code == 413


async def test_resent_archive_counts_once_in_quota(connect_service: ConnectService) -> None:
    """As by a client that did not hear the answer."""
    photographs = [photograph(400 + number, 300) for number in range(3)]
    archive = build_zip(ZipMember("images/a.png", photographs[0]), ZipMember("images/b.png", photographs[1]))

    async with connect_service(quota_bytes=len(photographs[0]) + len(photographs[1]) + 500) as (
        http,
        _,
    ):
        dataset = (await http.post("/v1/datasets", json={"name": "d"})).headers["Location"]
        answers = [await http.put(f"{dataset}/archive", content=archive) for _ in range(2)]
        assert [answer.status_code for answer in answers] == [200, 200], answers[1].text
        further = build_zip(ZipMember("images/c.png", photographs[2]))
        refused = await http.put(f"{dataset}/archive", content=further)
        assert refused.status_code == 413, refused.text
        assert len((await http.get(f"{dataset}/files")).json()["files"]) == 2


async def test_retried_upload_transaction_counts_once(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, left = photograph(), [2]
    put_files = rows.put_files

    async def deadlocked(*given: Any) -> Any:
        if left[0]:
            left[0] -= 1
            raise psycopg.errors.DeadlockDetected
        return await put_files(*given)

    monkeypatch.setattr(rows, "put_files", deadlocked)

    async with connect_service() as (http, service):
        dataset = (await http.post("/v1/datasets", json={"name": "d"})).headers["Location"]
        assert (await http.put(f"{dataset}/files/images/a.png", content=content)).status_code == 201
        assert left == [0] and service.metrics.upload_bytes._value.get() == len(content)


async def test_repeated_request_to_next_version_is_idempotent(connect_service: ConnectService) -> None:
    class LaterJob(NewJob):
        further: str | None = None

    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        asked = {**TOY, "dataset_id": dataset}
        first = await http.post("/v1/jobs", json=asked, headers={"Idempotency-Key": "k"})
        async with service.pool.connection() as connection:
            job = await get_job(connection, uuid.UUID(first.json()["id"]))
        assert job is not None
        who = Principal(job.owner, frozenset({"read", "write"}), uuid.uuid4())
        again = await submit_job(service, who, LaterJob.model_validate(asked), idempotency_key="k")
        assert str(again.id) == first.json()["id"]


async def test_event_stream_of_deleted_job_ends(
    connect_service: ConnectService, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.ERROR):
        async with connect_service(ping_seconds=0.2) as (http, service):
            job = await new_job(http, dataset_id=await committed_dataset(service))
            stream = asyncio.create_task(http.get(f"/v1/jobs/{job['id']}/events"))
            while not service.event_broker.subscriber_count:
                await asyncio.sleep(0.02)
            await asyncio.sleep(1)  # past events are read after the stream is known
            async with service.pool.connection() as connection:
                await connection.execute("DELETE FROM jobs WHERE id = %s", [uuid.UUID(job["id"])])
            answer = await asyncio.wait_for(stream, 60)
            assert answer.status_code == 200 and '"state": "queued"' in answer.text
            assert not service.event_broker.subscriber_count
    assert not caplog.records


@pytest.mark.parametrize("text", ["10.0.0.1", "10.0.0.1, 192.168.0.0/16", '["10.0.0.1"]', ""])
def test_settings_with_several_values_are_written_plainly(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv("OCTASPLAT_PROXIES", text)
    proxies = [str(network) for network in load_settings(ServiceSettings).proxies]
    assert proxies == [
        f"{p}/32" if "/" not in p else p for p in text.strip('[]"').replace(" ", "").split(",") if p
    ]


@pytest.mark.parametrize(
    ("name", "text"), [("PROXIES", "nowhere"), ("PROXIES", "[10"), ("KEEP_JOBS_HOURS_BY_KIND", "render=1")]
)
def test_unreadable_settings_are_named(monkeypatch: pytest.MonkeyPatch, name: str, text: str) -> None:
    monkeypatch.setenv(f"OCTASPLAT_{name}", text)
    with pytest.raises(ConfigError, match=f"(?i){name}"):
        load_settings(ServiceSettings)
