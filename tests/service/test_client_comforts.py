"""What client authors expect: one ZIP of all results, usage, request ids, compression, described webhooks."""

import hashlib
import io
import itertools
import json
import logging
import threading
import uuid
import zipfile
from typing import Any

import httpx
import pytest

from octasplat.service.app import create_app
from octasplat.service.request_id import RequestIdFilter
from octasplat.service.state import Service
from octasplat.service.zip_stream import ZipEntry, stream_zip
from octasplat.workers.db.live_scenes import LiveScene, put_live_scene
from octasplat.workers.db.quotas import Quota, set_quota
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.storage.protocol import Blob
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    client_with_token,
    committed_dataset,
    new_job,
    store_content,
)

RESULTS = {"scene.ply": b"ply\n" * 1000, "renders/view 1.png": bytes(range(256)) * 9, "empty.txt": b""}


async def finished_job(http: httpx.AsyncClient, service: Service) -> dict[str, Any]:
    job = await new_job(http, service)
    attempt = await claim_job(service, job)
    files = [
        ResultFile(name, store_content(service, content), len(content), "application/octet-stream")
        for name, content in RESULTS.items()
    ]
    await attempt.succeed(files)
    return job


async def test_all_results_come_as_one_zip(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await finished_job(http, service)
        answer = await http.get(f"/v1/jobs/{job['id']}/archive", headers={"Accept-Encoding": "gzip"})
        assert (answer.status_code, answer.headers["Content-Type"]) == (200, "application/zip")
        assert "Content-Encoding" not in answer.headers
        assert answer.headers["Content-Disposition"].endswith(f'-{job["id"][-12:]}.zip"')
        with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
            assert archive.testzip() is None
            assert {name: archive.read(name) for name in archive.namelist()} == RESULTS
        again = await http.get(f"/v1/jobs/{job['id']}/archive")
        assert again.content == answer.content
        waiting = await new_job(http, service)
        assert (await http.get(f"/v1/jobs/{waiting['id']}/archive")).status_code == 404
        stranger = await client_with_token(service, "stranger", "read")
        assert (await http.get(f"/v1/jobs/{job['id']}/archive", headers=stranger)).status_code == 404


async def test_results_are_looked_up_at_once_before_they_come_as_one_zip(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bucket answers each look-up after some time, and thousands of results would let a client give up."""
    async with connect_service() as (http, service):
        job = await finished_job(http, service)
        together, calls, stat = threading.Barrier(len(RESULTS)), itertools.count(), service.storage.stat

        def stat_with_others(sha256: str) -> Blob:
            if next(calls) < len(RESULTS):
                together.wait(20)
            return stat(sha256)

        with monkeypatch.context() as patch:
            patch.setattr(service.storage, "stat", stat_with_others)
            assert (await http.get(f"/v1/jobs/{job['id']}/archive")).status_code == 200
        service.storage.delete(hashlib.sha256(RESULTS["empty.txt"]).hexdigest())
        assert (await http.get(f"/v1/jobs/{job['id']}/archive")).status_code == 410


def test_zip_is_made_in_pieces_however_large_its_entries_are() -> None:
    from datetime import datetime

    piece, count = bytes(1 << 20), 2100  # more than 2 GiB, which needs ZIP64
    digest = hashlib.sha256()
    size, largest = 0, 0
    entries = [ZipEntry("large.bin", count << 20, lambda: (piece for _ in range(count)))]
    for part in stream_zip(entries, datetime(2026, 1, 2)):
        size, largest = size + len(part), max(largest, len(part))
        digest.update(part[:64])
    assert count << 20 < size < (count << 20) + 1000 and largest < 2 << 20


async def test_owners_see_their_quota_and_use(connect_service: ConnectService) -> None:
    async with connect_service(quota_jobs=7) as (http, service):
        me = await client_with_token(service, "me", "write")
        dataset = await committed_dataset(service, "me")
        mine = {"kind": "toy", "dataset_id": dataset}
        jobs = [(await http.post("/v1/jobs", json=mine, headers=me)).json() for _ in range(2)]
        await (await claim_job(service, jobs[0])).succeed(
            [ResultFile("a.bin", store_content(service, b"12345"), 5, "application/octet-stream")]
        )
        async with service.pool.connection() as connection:
            await set_quota(connection, "me", Quota(max_bytes=1000))
            await connection.execute(
                "UPDATE jobs SET started_at = finished_at - interval '90 s' WHERE id = %s", [jobs[0]["id"]]
            )
        found = (await http.get("/v1/usage", headers=me)).json()
        assert found["owner"] == "me"
        assert found["bytes"] == {"used": 5, "limit": 1000}
        assert found["datasets"] == {"used": 1, "limit": None}
        assert found["jobs"] == {"used": 1, "limit": 7}
        assert found["job_seconds"] == pytest.approx(90)
        other = (await http.get("/v1/usage")).json()
        assert other["jobs"]["used"] == other["job_seconds"] == 0


async def test_quotas_are_told_as_rate_limits(connect_service: ConnectService) -> None:
    async with connect_service(quota_jobs=2) as (http, service):
        body = {"kind": "toy", "dataset_id": await committed_dataset(service)}
        answers = [await http.post("/v1/jobs", json=body) for _ in range(3)]
        assert [answer.status_code for answer in answers] == [202, 202, 429]
        told = [answer.headers["RateLimit"] for answer in answers]
        assert told == ['"jobs";r=1', '"jobs";r=0', '"jobs";r=0']
        assert answers[0].headers["RateLimit-Policy"] == '"jobs";q=2'
        assert int(answers[2].headers["Retry-After"]) > 0
        unlimited = await http.post("/v1/datasets", json={})
        assert unlimited.status_code == 201 and "RateLimit" not in unlimited.headers


async def test_progress_and_time_left_are_of_the_whole_job(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        job = (await http.post("/v1/jobs", json={"dataset_id": dataset})).json()
        address = f"/v1/jobs/{job['id']}"
        assert (job["progress"], job["total_seconds_left"]) == (0.0, None)
        estimate = {
            "cpu_seconds": 1.0, "seconds": 1.0, "cores": 1, "memory_bytes": 1,
            "stage_seconds": {"load": 10.0, "train": 60.0, "evaluate": 20.0, "export": 10.0},
        }  # fmt: skip
        await claim_job(service, job)

        async def found(stage: str, step: int | None, total: int | None, left: float | None) -> list[Any]:
            async with service.pool.connection() as connection:
                await connection.execute(
                    "UPDATE jobs SET stage = %s, step = %s, total_steps = %s, seconds_left = %s, "
                    "estimate = %s WHERE id = %s",
                    [stage, step, total, left, json.dumps(estimate), job["id"]],
                )
            view = (await http.get(address)).json()
            return [view["progress"], view["total_seconds_left"]]

        assert await found("load", None, None, None) == [0.0, None]
        # Half of the training took twice as long as estimated, and so will the 30 s of the other stages.
        assert await found("train", 50, 100, 60.0) == [0.4, 120.0]
        assert await found("export", 1, 2, 7.0) == [0.95, 7.0]
        estimate["stage_seconds"] = {}
        assert await found("train", 50, 100, 60.0) == [0.375, None]


async def test_requests_have_ids_in_answers_problems_and_logs(
    connect_service: ConnectService, caplog: pytest.LogCaptureFixture
) -> None:
    async with connect_service() as (http, _service):
        first, second = [await http.get("/v1/info") for _ in range(2)]
        assert first.headers["X-Request-ID"] != second.headers["X-Request-ID"]
        missing = await http.get(f"/v1/datasets/{'0' * 32}", headers={"X-Request-ID": "mine-1"})
        assert missing.headers["X-Request-ID"] == missing.json()["request_id"] == "mine-1"
        odd = await http.get("/healthz", headers={"X-Request-ID": "a b"})
        assert odd.headers["X-Request-ID"] != "a b"
        refused = await http.get("/healthz", headers={"Host": "elsewhere.example"})
        assert refused.status_code == 421 and refused.headers["X-Request-ID"] == refused.json()["request_id"]
        with caplog.filtering(RequestIdFilter()), caplog.at_level(logging.WARNING):
            body = {"name": "a\0b", "owner": "me", "scopes": ["read"]}
            nul = await http.post("/v1/tokens", json=body, headers={"X-Request-ID": "mine-2"})
        assert nul.status_code == 422 and "[request mine-2]" in caplog.text


async def test_lists_are_compressed_and_stored_content_is_not(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await finished_job(http, service)
        for _ in range(10):
            await new_job(http, service)
        packed = await http.get("/v1/jobs", headers={"Accept-Encoding": "gzip"})
        assert packed.headers["Content-Encoding"] == "gzip"
        assert int(packed.headers["Content-Length"]) < len(packed.content) / 3
        plain = await http.get("/v1/jobs", headers={"Accept-Encoding": "identity"})
        assert "Content-Encoding" not in plain.headers and plain.json() == packed.json()
        for name, content in RESULTS.items():
            answer = await http.get(
                f"/v1/jobs/{job['id']}/artifacts/{name}", headers={"Accept-Encoding": "gzip"}
            )
            assert answer.content == content and "Content-Encoding" not in answer.headers
            assert int(answer.headers["Content-Length"]) == len(content)


async def test_reports_and_states_of_trainings_are_sent_as_they_are_stored(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        attempt = await claim_job(service, job)
        page = b"<p>A report.</p>" * 200
        sha256 = store_content(service, page)
        await attempt.succeed([ResultFile("report.html", sha256, len(page), "text/html")])
        async with service.pool.connection() as connection:
            await put_live_scene(connection, LiveScene(uuid.UUID(job["id"]), sha256, sha256, 1, 1))
        for address in (f"/v1/jobs/{job['id']}/live-scene", f"/jobs/{job['id']}/report"):
            answer = await http.get(address, headers={"Accept-Encoding": "gzip"})
            assert answer.content == page and "Content-Encoding" not in answer.headers, address
            assert int(answer.headers["Content-Length"]) == len(page)


def test_messages_to_webhooks_are_described() -> None:
    document = create_app().openapi()
    ends = {"job.succeeded", "job.failed", "job.canceled"}
    assert ends | {"job.queued", "job.running", "job.canceling", "webhook.test"} == set(document["webhooks"])
    operation = document["webhooks"]["job.succeeded"]["post"]
    assert operation["operationId"] == "onJobSucceeded"
    assert {p["name"] for p in operation["parameters"]} == {
        "webhook-id", "webhook-timestamp", "webhook-signature"
    }  # fmt: skip
    reference = operation["requestBody"]["content"]["application/json"]["schema"]["$ref"]
    message = document["components"]["schemas"][reference.rpartition("/")[2]]
    assert {"type", "timestamp", "data"} == set(message["properties"])
