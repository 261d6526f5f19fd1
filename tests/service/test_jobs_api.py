"""Jobs over HTTP: accepted once, found again, followed, stopped, fetched."""

import asyncio
import json
import uuid
from collections.abc import AsyncIterator
from typing import Any

import httpx
import pytest

from octasplat.workers.queue.job_results import ResultFile
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    committed_dataset,
    new_job,
    store_content,
)


def is_problem(answer: httpx.Response, status: int, code: str) -> bool:
    assert answer.headers["content-type"] == "application/problem+json", answer.text
    assert (answer.status_code, answer.json()["type"]) == (status, f"urn:octasplat:problem:{code}"), (
        answer.text
    )
    return answer.json()["status"] == status and answer.json()["detail"].endswith((".", "!"))


async def test_former_names_of_options_are_read_and_noted_in_the_answer(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        former = {"preset": "paper", "train": {"rates": {"quat": 0.5}, "rays": 512}}
        job = (await http.post("/v1/jobs", json={"dataset_id": dataset, "options": former})).json()
        new = {"preset": "redisplats", "train": {"lr": {"quat": 0.5}, "rays_per_batch": 512}}
        same = (await http.post("/v1/jobs", json={"dataset_id": dataset, "options": new})).json()
        assert job["options"] == same["options"]
        notes = [note for note in job["notes"] if "rates.quat is called lr.quat now" in note]
        assert notes and set(job["notes"]) - set(same["notes"]) >= set(notes)
        assert not [note for note in same["notes"] if "is called" in note]


async def test_job_is_accepted_with_every_setting(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        options = {"preset": "fast", "train": {"iterations": 70}}
        answer = await http.post("/v1/jobs", json={"dataset_id": dataset, "options": options, "label": "a"})
        job = answer.json()
        assert answer.status_code == 202 and answer.headers["Location"] == f"/v1/jobs/{job['id']}"
        assert int(answer.headers["Retry-After"]) >= 1
        assert (job["state"], job["attempt"], job["queue_position"]) == ("queued", 0, 0)
        assert job["stages"] == ["load", "train", "evaluate", "export"]
        train = job["options"]["train"]
        assert (train["iterations"], train["max_gaussians_auto"]) == (70, 50_000)
        assert job["options"]["test_every"] == 8
        assert uuid.UUID(job["id"]).version == 7
        found = await http.get(answer.headers["Location"])
        assert found.json() == job


@pytest.mark.parametrize(
    ("body", "status", "code", "pointer"),
    [
        ({"kind": "nonsense"}, 422, "kind", "#/kind"),
        ({"options": {"preset": "best"}}, 422, "options", "#/options/preset"),
        ({"options": {"train": {"iterations": -1}}}, 422, "options", "#/options/train/iterations"),
        ({"options": {"train": 5}}, 422, "options", "#/options/train"),
        ({"options": {"speed": 1}}, 422, "options", "#/options/speed"),
        ({"options": {"exports": ["../../x.ply"]}}, 422, "options", "#/options/exports/0"),
        ({"options": {"exports": ["scene.ply"]}}, 422, "options", "#/options/exports/0"),
        ({"options": {"exports": ["x.docx"]}}, 422, "options", "#/options/exports/0"),
        ({"dataset_id": str(uuid.UUID(int=5))}, 422, "input", "#/dataset_id"),
        ({"dataset_id": None}, 422, "input", "#/dataset_id"),
        ({"dataset_id": "x"}, 422, "request", "#/dataset_id"),
        ({"priority": 1000}, 422, "request", "#/priority"),
        ({"queue": "no such; queue"}, 422, "request", "#/queue"),
        ({"extra": 1}, 422, "request", "#/extra"),
        ({"kind": "export", "options": {"files": ["a.glb"]}}, 422, "input", "#/source_id"),
    ],
)
async def test_create_job_invalid_request_is_refused(
    connect_service: ConnectService, body: dict[str, Any], status: int, code: str, pointer: str
) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        answer = await http.post("/v1/jobs", json={"dataset_id": dataset, **body})
        assert is_problem(answer, status, code)
        assert pointer in [error["pointer"] for error in answer.json()["errors"]]
        assert (await http.get("/v1/jobs")).json()["jobs"] == []


async def test_dataset_must_be_committed_and_have_poses(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        made = (await http.post("/v1/datasets", json={"name": "x"})).json()
        assert is_problem(await http.post("/v1/jobs", json={"dataset_id": made["id"]}), 409, "dataset-open")
        without = await committed_dataset(service, has_poses=False)
        given = {"dataset_id": without, "options": {"poses": "given"}}
        assert is_problem(await http.post("/v1/jobs", json=given), 422, "poses")
        found = {"dataset_id": without, "options": {"poses": "auto"}}
        answer = await http.post("/v1/jobs", json=found)
        assert answer.status_code == 202
        assert answer.json()["stages"][:4] == ["read", "features", "matches", "poses"]


async def test_poses_are_found_only_where_they_are_missing(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        for has_poses, kept, first in ((True, "given", "load"), (False, "auto", "read")):
            dataset = await committed_dataset(service, has_poses=has_poses)
            asked = {"dataset_id": dataset, "options": {}}
            job = (await http.post("/v1/jobs", json=asked)).json()
            assert (job["options"]["poses"], job["stages"][0]) == (kept, first)


async def test_idempotency_key_makes_one_job(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        body = {"kind": "toy", "dataset_id": await committed_dataset(service)}
        headers = {"Idempotency-Key": "once"}
        answers = await asyncio.gather(*(http.post("/v1/jobs", json=body, headers=headers) for _ in range(6)))
        assert {a.status_code for a in answers} == {202} and len({a.json()["id"] for a in answers}) == 1
        other = await http.post("/v1/jobs", json={**body, "label": "b"}, headers=headers)
        assert is_problem(other, 422, "idempotency-key")
        assert len((await http.get("/v1/jobs")).json()["jobs"]) == 1
        refused = {"Idempotency-Key": "refused"}
        wrong = {**body, "dataset_id": str(uuid.uuid4())}
        assert (await http.post("/v1/jobs", json=wrong, headers=refused)).status_code == 422
        # What was refused has made nothing, so the key is free.
        assert (await http.post("/v1/jobs", json=body, headers=refused)).status_code == 202


async def test_polling_is_cheap_and_changes_are_guarded(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        address = f"/v1/jobs/{job['id']}"
        first = await http.get(address)
        seen = {"If-None-Match": first.headers["ETag"]}
        again = await http.get(address, headers=seen)
        assert (again.status_code, again.content) == (304, b"")
        attempt = await claim_job(service, job)
        changed = await http.get(address, headers=seen)
        assert changed.status_code == 200 and changed.json()["state"] == "running"
        await attempt.heartbeat()  # a heartbeat alone changes nothing that anybody sees
        assert (
            await http.get(address, headers={"If-None-Match": changed.headers["ETag"]})
        ).status_code == 304
        stale = await http.patch(address, json={"label": "x"}, headers={"If-Match": first.headers["ETag"]})
        assert is_problem(stale, 412, "precondition")
        fresh = await http.patch(
            address, json={"label": "x", "pinned": True}, headers={"If-Match": changed.headers["ETag"]}
        )
        assert (fresh.json()["label"], fresh.json()["pinned"]) == ("x", True)


async def test_job_can_be_cancelled_retried_and_deleted(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        address = f"/v1/jobs/{job['id']}"
        assert is_problem(await http.delete(address), 409, "conflict")
        assert is_problem(await http.post(f"{address}/retry"), 409, "conflict")
        assert (await http.post(f"{address}/cancel")).json()["state"] == "canceled"
        assert (await http.post(f"{address}/cancel")).status_code == 202
        once = {"Idempotency-Key": "r"}
        retried = await http.post(
            f"{address}/retry", json={"from": "start"}, headers={"Idempotency-Key": "r"}
        )
        assert (retried.status_code, retried.json()["state"]) == (202, "queued")
        again = await http.post(f"{address}/retry", json={"from": "start"}, headers=once)
        assert again.status_code == 202
        attempt = await claim_job(service, job)
        stopping = await http.delete(address, params={"cancel": True})
        assert is_problem(stopping, 409, "stopping") and "Retry-After" in stopping.headers
        await attempt.cancel()
        assert (await http.delete(address, params={"cancel": True})).status_code == 204
        assert is_problem(await http.get(address), 404, "not-found")


async def test_job_list_is_paginated(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        made = [(await new_job(http, service, label=f"l{n}"))["id"] for n in range(5)]
        address, found = "/v1/jobs?limit=2", []
        while address:
            answer = await http.get(address)
            found += [job["id"] for job in answer.json()["jobs"]]
            address = answer.links.get("next", {}).get("url", "")
        assert found == list(reversed(made))
        await http.post(f"/v1/jobs/{made[0]}/cancel")
        query = [("state", "canceled"), ("state", "failed")]
        assert [j["id"] for j in (await http.get("/v1/jobs", params=query)).json()["jobs"]] == [made[0]]
        assert [j["id"] for j in (await http.get("/v1/jobs?label=l3")).json()["jobs"]] == [made[3]]
        assert is_problem(await http.get("/v1/jobs?cursor=abc"), 422, "cursor")
        assert is_problem(await http.get("/v1/jobs?state=odd"), 422, "request")
        assert is_problem(await http.get("/v1/jobs?limit=0"), 422, "request")


async def test_results_in_ranges_with_digest(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        attempt = await claim_job(service, job)
        content = bytes(range(256)) * 20
        sha256 = store_content(service, content)
        page = store_content(service, b"<script>alert(1)</script>")
        await attempt.succeed(
            [
                ResultFile("mesh.glb", sha256, len(content), "model/gltf-binary"),
                ResultFile("report.html", page, 25, "text/html"),
                ResultFile("renders/ü 1.bin", sha256, len(content), "application/octet-stream"),
            ]
        )
        address = f"/v1/jobs/{job['id']}/artifacts"
        assert [a["name"] for a in (await http.get(address)).json()["artifacts"]] == [
            "mesh.glb", "renders/ü 1.bin", "report.html",
        ]  # fmt: skip
        whole = await http.get(f"{address}/mesh.glb")
        assert whole.content == content and whole.headers["ETag"] == f'"{sha256}"'
        assert whole.headers["Repr-Digest"].startswith("sha-256=:")
        part = await http.get(
            f"{address}/mesh.glb", headers={"Range": "bytes=100-199", "If-Range": f'"{sha256}"'}
        )
        assert (part.status_code, part.content) == (206, content[100:200])
        assert part.headers["Content-Range"] == f"bytes 100-199/{len(content)}"
        stale = await http.get(f"{address}/mesh.glb", headers={"Range": "bytes=0-9", "If-Range": '"other"'})
        assert (stale.status_code, stale.content) == (200, content)
        beyond = await http.get(f"{address}/mesh.glb", headers={"Range": "bytes=99999-"})
        assert beyond.status_code == 416
        known = await http.get(f"{address}/mesh.glb", headers={"If-None-Match": f'"{sha256}"'})
        assert (known.status_code, known.content) == (304, b"")
        head = await http.head(f"{address}/mesh.glb")
        assert (head.headers["Content-Length"], head.content) == (str(len(content)), b"")
        named = await http.get(f"{address}/renders/ü 1.bin")
        assert "filename*=UTF-8''%C3%BC%201.bin" in named.headers["Content-Disposition"]
        report = await http.get(f"{address}/report.html?inline=true")
        assert "script-src 'none'" in report.headers["Content-Security-Policy"]
        assert (
            (await http.get(f"{address}/report.html")).headers["Content-Disposition"].startswith("attachment")
        )
        assert is_problem(await http.get(f"{address}/none"), 404, "not-found")
        assert is_problem(await http.get(f"{address}/a%00b"), 404, "not-found")
        service.storage.delete(sha256)
        assert is_problem(await http.get(f"{address}/mesh.glb"), 410, "content-gone")


async def test_export_of_a_finished_job(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        source = await new_job(http, service)
        body = {"kind": "export", "source_id": source["id"], "options": {"files": ["a.glb"]}}
        assert is_problem(await http.post("/v1/jobs", json=body), 409, "source")
        attempt = await claim_job(service, source)
        await attempt.succeed(
            [ResultFile("scene.ply", "a" * 64, 1, "x/y"), ResultFile("config.json", "b" * 64, 1, "x/y")]
        )
        answer = await http.post("/v1/jobs", json=body)
        assert answer.status_code == 202 and answer.json()["dataset_id"] == source["dataset_id"]
        assert is_problem(await http.delete(f"/v1/jobs/{source['id']}"), 409, "conflict")
        await http.post(f"/v1/jobs/{answer.json()['id']}/cancel")
        assert (await http.delete(f"/v1/jobs/{source['id']}")).status_code == 204


async def events_of(response: httpx.Response) -> AsyncIterator[tuple[str, str, dict[str, Any]]]:
    kind = number = data = ""
    async for line in response.aiter_lines():
        name, _, value = line.partition(": ")
        if name == "event":
            kind = value
        elif name == "id":
            number = value
        elif name == "data":
            data = value
        elif not line and data:
            yield kind, number, json.loads(data)
            data = ""


async def test_log_timeline_and_stream(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        attempt = await claim_job(service, job)
        await attempt.add_log_lines([f"line {n}" for n in range(5)])
        page = (await http.get(f"/v1/jobs/{job['id']}/logs?limit=3")).json()
        assert [line["text"] for line in page["lines"]] == ["Attempt 1", "line 0", "line 1"]
        rest = (await http.get(f"/v1/jobs/{job['id']}/logs", params={"after": page["next"]})).json()
        assert [line["text"] for line in rest["lines"]] == ["line 2", "line 3", "line 4"]
        await attempt.set_progress(
            stage="train", step=3, total_steps=9, training_psnr=20.5, event={"step": 3}
        )
        await attempt.succeed([])
        timeline = (await http.get(f"/v1/jobs/{job['id']}/timeline")).json()
        kinds = [event["kind"] for event in timeline["events"]]
        assert kinds == ["state", "state", "progress", "state"]
        whole = await http.get(f"/v1/jobs/{job['id']}/events")
        assert whole.headers["content-type"].startswith("text/event-stream")
        heard = [event async for event in events_of(whole)]
        assert [kind for kind, _, _ in heard] == kinds and heard[-1][2]["state"] == "succeeded"
        later = await http.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": heard[1][1]})
        assert [kind async for kind, _, _ in events_of(later)] == kinds[2:]
        done = await http.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": heard[-1][1]})
        assert done.status_code == 204


async def test_job_psnr_is_that_of_test_views(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        address = f"/v1/jobs/{job['id']}"
        attempt = await claim_job(service, job)

        async def figures() -> tuple[float | None, float | None]:
            view = (await http.get(address)).json()
            (listed,) = (await http.get("/v1/jobs")).json()["jobs"]
            assert (view["psnr"], view["training_psnr"]) == (listed["psnr"], listed["training_psnr"])
            return view["psnr"], view["training_psnr"]

        assert await figures() == (None, None)
        await attempt.set_progress(stage="train", step=10, total_steps=900, training_psnr=33.19)
        assert await figures() == (None, 33.19)
        await attempt.add_event("held_out_measured", {"iteration": 20, "psnr": 27.5})
        await attempt.set_progress(stage="train", step=20, total_steps=900, training_psnr=34.0)
        assert await figures() == (27.5, 34.0)
        await attempt.cancel()
        answer = await http.post(f"{address}/retry", json={"from": "checkpoint"})
        assert (answer.json()["psnr"], answer.json()["training_psnr"]) == (27.5, 34.0)
        attempt = await claim_job(service, answer.json())
        await attempt.succeed([], 28.56)
        assert await figures() == (28.56, 34.0)


async def test_info_describes_service(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        info = (await http.get("/v1/info")).json()
        assert {"reconstruct", "evaluate", "export", "render", "toy"} <= set(info["kinds"])
        assert "glb" in [form["name"] for form in info["formats"]]
        schema = (await http.get("/v1/options/reconstruct")).json()["options"]
        assert schema["properties"]["preset"]["enum"] == ["fast", "standard", "high", "redisplats"]
        assert is_problem(await http.get("/v1/options/nothing"), 404, "not-found")
        await new_job(http, service)
        (cpu,) = (await http.get("/v1/queues")).json()["queues"]
        assert (cpu["queue"], cpu["waiting"], cpu["running"], cpu["slots"]) == ("cpu", 1, 0, 0)
        assert (await http.get("/healthz")).json()["status"] == "ok"
        assert (await http.get("/readyz")).json()["checks"]["database"] == "ok"
        async with service.pool.connection() as connection:
            await connection.execute("DELETE FROM schema_steps WHERE name = '0001_jobs.sql'")
        ready = await http.get("/readyz")
        assert (ready.status_code, ready.json()["checks"]["database"]) == (503, "outdated")


async def test_document_has_examples_and_describes_errors(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        document = (await http.get("/openapi.json")).json()
        assert document["openapi"].startswith("3.1")
        schemas = document["components"]["schemas"]
        assert "ProblemDocument" in schemas and "HTTPValidationError" not in schemas
        for name in ("NewJob", "JobView", "NewDataset", "DatasetView", "FileView", "ArtifactView"):
            assert schemas[name]["examples"], name
        create = document["paths"]["/v1/jobs"]["post"]
        assert "application/problem+json" in create["responses"]["422"]["content"]
        assert any(p["name"].lower() == "idempotency-key" for p in create["parameters"])


async def test_long_bodies_and_odd_ones(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        assert is_problem(await http.post("/v1/jobs", content=b"x" * 2_000_000), 413, "too-large")

        async def endless() -> AsyncIterator[bytes]:
            for _ in range(64):
                yield b"y" * 65536

        assert (await http.post("/v1/jobs", content=endless())).status_code == 413
        assert is_problem(await http.post("/v1/jobs", content=b"{"), 422, "request")
        assert is_problem(await http.post("/nowhere"), 404, "not-found")
        assert is_problem(await http.put("/v1/info"), 405, "method-not-allowed")


async def test_lost_database_is_503(connect_service: ConnectService, conninfo: str) -> None:
    async with connect_service() as (http, service):
        await service.pool.close()
        answer = await http.get("/v1/jobs")
        assert is_problem(answer, 503, "database") and answer.headers["Retry-After"]
        assert (await http.get("/healthz")).status_code == 200
        assert (await http.get("/readyz")).json()["checks"]["database"] == "unreachable"
