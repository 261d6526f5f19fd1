"""A job in blocks over HTTP: its blocks in its own view, and no trace of them elsewhere."""

from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import httpx
import pytest

from octasplat.engine.core import versions
from octasplat.service.state import Service
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.block_jobs import NewBlock
from octasplat.workers.queue.storage_leases import storage_lease
from tests.support.service_harness import ConnectService, claim_job, committed_dataset, new_job, store_content


async def job_in_blocks(
    http: httpx.AsyncClient,
    service: Service,
    places: Mapping[str, tuple[float, float]] | None = None,
    before_blocks: Callable[[Attempt], Awaitable[None]] | None = None,
    **body: Any,
) -> dict[str, Any]:
    """A job that waits for two blocks of 20 and 10 iterations, after 5 and with 5 more to come.

    With ``places`` there is a map of them. ``before_blocks`` is called with the attempt that plans them.
    """
    job = await new_job(http, service, **body)
    digest = store_content(service, b"plan")
    files = [{"path": "run/blocks/plan.npz", "sha256": digest, "size_bytes": 4}]
    checkpoint = {
        "attempt": 1, "stage": "train", "step": 5, "files": files, "results": versions.RESULTS_VERSION,
    }  # fmt: skip
    blocks = [
        NewBlock(number, length, {"number": number, "iterations": length, "plan": digest})
        for number, length in ((1, 20), (2, 10))
    ]
    attempt = await claim_job(service, job)
    if before_blocks is not None:
        await before_blocks(attempt)
    async with storage_lease(service.pool, service.storage) as lease:
        if places is not None:
            row = {"sha256": store_content(service, b"map"), "step": 5, "view": None}
            await attempt.record_preview(row, lease, block_positions=places)
        await attempt.start_blocks(
            service.job_queue, checkpoint, "toy", blocks, lease, first_steps=5, total_steps=40
        )
    return job


async def read(http: httpx.AsyncClient, job: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = (await http.get(f"/v1/jobs/{job['id']}")).json()
    return found


async def test_blocks_are_in_the_view_of_their_job_only(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await job_in_blocks(http, service)
        view = await read(http, job)
        assert (view["state"], view["stage"], view["step"], view["total_steps"]) == (
            "running",
            "train",
            5,
            40,
        )
        assert [(block["name"], block["state"]) for block in view["blocks"]] == [
            ("block 1", "queued"),
            ("block 2", "queued"),
        ]
        assert [found["id"] for found in (await http.get("/v1/jobs")).json()["jobs"]] == [job["id"]]
        assert (await http.get("/v1/usage")).json()["jobs"]["used"] == 1
        page = (await http.get(f"/jobs/{job['id']}")).text
        assert "block 2</a>" in page and "0 of 2 trained" in page
        for block in view["blocks"]:
            for method, where in (("POST", "/cancel"), ("POST", "/retry"), ("DELETE", "")):
                answer = await http.request(method, f"/v1/jobs/{block['id']}{where}")
                assert answer.status_code == 409 and job["id"] in answer.json()["detail"]


async def test_progress_and_time_left_are_of_all_blocks(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await job_in_blocks(http, service)
        view = await read(http, job)
        tag = (await http.get(f"/v1/jobs/{job['id']}")).headers["ETag"]
        long, short = view["blocks"]
        attempt = await claim_job(service, long)
        await attempt.set_progress(stage="load", step=12, total_steps=15, seconds_left=1.0)
        loading = await read(http, job)  # photographs that were read are no iterations
        assert (loading["step"], loading["seconds_left"]) == (5, None)
        assert loading["blocks"][0]["state"] == "running" and loading["blocks"][0]["step"] is None
        await attempt.set_progress(stage="train", step=10, total_steps=20, seconds_left=30.0)
        seen = await http.get(f"/v1/jobs/{job['id']}", headers={"If-None-Match": tag})
        assert seen.status_code == 200
        # 3 s an iteration: 20 of one worker at a time, then 5 of the end
        assert (seen.json()["step"], seen.json()["seconds_left"]) == (15, 75.0)
        (listed,) = (await http.get("/v1/jobs")).json()["jobs"]
        assert (listed["step"], listed["seconds_left"]) == (15, 75.0)
        other = await claim_job(service, short)
        await other.set_progress(stage="train", step=0, total_steps=10, seconds_left=30.0)
        assert (await read(http, job))["seconds_left"] == 30.0 + 15.0
        await attempt.succeed([], job_queue=service.job_queue)
        view = await read(http, job)
        assert view["step"] == 25 and [block["state"] for block in view["blocks"]] == ["succeeded", "running"]
        timeline = (await http.get(f"/v1/jobs/{job['id']}/timeline")).json()["events"]
        told = {event["kind"]: event["data"] for event in timeline}
        assert told["blocks_queued"] == {"blocks": 2, "done": 0}
        assert told["block_finished"] == {"block": 1, "left": 1}
        await other.succeed([], job_queue=service.job_queue)
        queued = await read(http, job)
        await claim_job(service, job)
        for view in (queued, await read(http, job)):  # the merge begins where the blocks have ended
            assert (view["stage"], view["step"], view["total_steps"]) == ("train", 35, 40)
            assert view["progress"] > seen.json()["progress"]


async def test_job_is_one_start_and_its_time_is_that_of_the_whole(connect_service: ConnectService) -> None:
    async with connect_service(webhook_hosts=("hooks.example",)) as (http, service):
        hook = {"url": "https://hooks.example/a", "events": ["job.succeeded"]}
        assert (await http.post("/v1/webhooks", json=hook)).status_code == 201
        job = await job_in_blocks(http, service)
        planned = await read(http, job)
        for block in planned["blocks"]:
            await (await claim_job(service, block)).succeed([], job_queue=service.job_queue)
        assert (await read(http, job))["attempt"] == 1  # queued to be merged
        merge = await claim_job(service, job)
        view = await read(http, job)
        assert (view["attempt"], view["started_at"]) == (1, planned["started_at"])
        await merge.requeue(service.job_queue, "its worker is stopping")
        merge = await claim_job(service, job)
        assert (await read(http, job))["attempt"] == 2  # that start was interrupted
        await merge.succeed([], job_queue=service.job_queue)
        view = await read(http, job)
        assert (view["state"], view["attempt"], view["started_at"]) == ("succeeded", 2, planned["started_at"])
        log = (await http.get(f"/v1/jobs/{job['id']}/logs")).json()["lines"]
        assert [(line["attempt"], line["text"]) for line in log if "Handed" not in line["text"]] == [
            (1, "Attempt 1"),
            (1, "Its blocks are trained"),
            (2, "Attempt 2"),
            (2, "Succeeded"),
        ]
        timeline = (await http.get(f"/v1/jobs/{job['id']}/timeline")).json()["events"]
        assert [event["attempt"] for event in timeline if event["data"].get("state") == "running"] == [
            1,
            1,
            2,
        ]
        assert " · attempt 2" in (await http.get(f"/jobs/{job['id']}")).text
        async with service.pool.connection() as connection:
            cursor = await connection.execute(
                "SELECT payload->'data'->'attempt' AS n FROM webhook_deliveries"
            )
            assert [row["n"] for row in await cursor.fetchall()] == [2]


async def test_blocks_are_on_a_map_with_their_states(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        places = {"1": (0.25, 0.5), "2": (0.75, 0.125)}
        job = await job_in_blocks(http, service, places)
        view = await read(http, job)
        assert [block["map_position"] for block in view["blocks"]] == [[0.25, 0.5], [0.75, 0.125]]
        assert set(view["preview"]) == {"sha256", "step", "view"} and view["preview"]["view"] is None
        attempt = await claim_job(service, view["blocks"][0])
        await attempt.set_progress(stage="train", step=5, total_steps=20, seconds_left=30.0)
        page = (await http.get(f"/parts/jobs/{job['id']}")).text
        assert "<title>block 1: running, 25 %</title>" in page and 'class="queued"' in page
        assert "translate(75.0 12.5)" in page and f'href="/v1/jobs/{job["id"]}/preview?step=5"' in page
        assert (await http.get(f"/v1/jobs/{job['id']}/preview")).content == b"map"
        whole = (await http.get(f"/jobs/{job['id']}")).text
        assert "None at step" not in whole


async def test_cancelling_ends_all_blocks_and_deleting_takes_them_along(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, service):
        job = await job_in_blocks(http, service)
        assert (await http.post(f"/v1/jobs/{job['id']}/cancel")).json()["state"] == "canceled"
        view = await read(http, job)
        assert [block["state"] for block in view["blocks"]] == ["canceled", "canceled"]
        assert (await http.delete(f"/v1/jobs/{job['id']}")).status_code == 204
        assert (await http.get(f"/v1/jobs/{view['blocks'][0]['id']}")).status_code == 404


async def test_webhooks_hear_of_the_job_and_of_none_of_its_blocks(connect_service: ConnectService) -> None:
    async with connect_service(webhook_hosts=("hooks.example",)) as (http, service):
        events = ["job.running", "job.canceled"]
        hook = {"url": "https://hooks.example/a", "events": events}
        assert (await http.post("/v1/webhooks", json=hook)).status_code == 201
        job = await job_in_blocks(http, service)
        for block in (await read(http, job))["blocks"]:
            await claim_job(service, block)
        await http.post(f"/v1/jobs/{job['id']}/cancel")
        async with service.pool.connection() as connection:
            cursor = await connection.execute(
                "SELECT payload->'data'->>'job_id' AS job FROM webhook_deliveries"
            )
            assert {row["job"] for row in await cursor.fetchall()} == {job["id"]}


async def test_options_of_blocks_are_accepted_and_checked(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)

        async def ask(**options: Any) -> httpx.Response:
            return await http.post("/v1/jobs", json={"dataset_id": dataset, "options": options})

        for options in ({"blocks": "auto", "memory": "8G"}, {"blocks": 4}):
            answer = await ask(**options)
            assert answer.status_code == 202, answer.text
            job = answer.json()
            assert {name: job["options"][name] for name in options} == options
            assert job["requested"] == {**options, "poses": "given"} and job["blocks"] == []
        plain = (await ask()).json()
        assert (plain["options"]["blocks"], plain["options"]["memory"]) == (None, None)
        retried = await _retry(http, job, {"blocks": 2})
        assert (retried["options"]["blocks"], retried["requested"]) == (2, {"blocks": 2, "poses": "given"})
        for options, place in (
            ({"memory": "8G"}, "memory"),
            ({"blocks": 2, "memory": "much"}, "memory"),
            ({"blocks": 0}, "blocks"),
            ({"blocks": 2, "materials": True}, "blocks"),
            ({"blocks": 2, "minutes": 5}, "blocks"),
        ):
            answer = await ask(**options)
            assert answer.status_code == 422, answer.text
            assert answer.json()["errors"][0]["pointer"].startswith(f"#/options/{place}"), answer.text


async def _retry(http: httpx.AsyncClient, job: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    await http.post(f"/v1/jobs/{job['id']}/cancel")
    answer = await http.post(f"/v1/jobs/{job['id']}/retry", json={"from": "start", "options": options})
    assert answer.status_code == 202, answer.text
    found: dict[str, Any] = answer.json()
    return found


@pytest.mark.parametrize("kind", ["reconstruct_block", "sing"])
async def test_nobody_can_ask_for_a_block(connect_service: ConnectService, kind: str) -> None:
    async with connect_service() as (http, service):
        body = {"kind": kind, "dataset_id": await committed_dataset(service), "options": {}}
        answer = await http.post("/v1/jobs", json=body)
        assert answer.status_code == 422 and answer.json()["errors"][0]["pointer"] == "#/kind"
        assert (await http.get(f"/v1/options/{kind}")).status_code == 404
        assert kind not in [known["name"] for known in (await http.get("/v1/options")).json()["kinds"]]
