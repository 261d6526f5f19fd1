"""Ceilings, priorities, estimates, and queues that nobody takes, over HTTP."""

import uuid
from typing import Any

import httpx
import pytest

from octasplat.service.state import Service
from octasplat.workers.db.datasets import put_file
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.workers import record_worker_heartbeat
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.queue.jobs import get_job, requeue_job
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    client_with_token,
    committed_dataset,
)

PHOTOGRAPHS = [{"width_px": 269, "height_px": 480, "count": 50}]


async def photographed_dataset(service: Service, width_px: int, height_px: int, count: int) -> str:
    dataset = await committed_dataset(service)
    async with service.pool.connection() as connection:
        await lock_owner(connection, "local")
        await connection.execute("UPDATE datasets SET state = 'open' WHERE id = %s", [dataset])
        for number in range(count):
            facts = {"kind": "PNG", "width_px": width_px, "height_px": height_px}
            digest = f"{number:064x}"
            await put_file(connection, uuid.UUID(dataset), f"images/{number}.png", digest, 1, facts)
        await connection.execute("UPDATE datasets SET state = 'committed' WHERE id = %s", [dataset])
    return dataset


def ceiling(answer: httpx.Response) -> tuple[str, int]:
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:octasplat:problem:ceiling"), answer.text
    [fault] = answer.json()["errors"]
    assert f"{fault['ceiling']:,}" in fault["detail"]
    return fault["pointer"], fault["ceiling"]


@pytest.mark.parametrize(
    ("options", "pointer", "allowed"),
    [
        ({"train": {"iterations": 10**20}}, "#/options/train/iterations", 100_000),
        ({"train": {"max_gaussians": 2e9}}, "#/options/train/max_gaussians", 5_000_000),
        ({"train": {"rays_per_batch": 10**9}}, "#/options/train/rays_per_batch", 1 << 20),
        ({"train": {"probe_rays": 10**9}}, "#/options/train/probe_rays", 1 << 20),
        ({"max_side": 10**6}, "#/options/max_side", 16_384),
        ({"exports": [f"{n}.glb" for n in range(21)]}, "#/options/exports", 20),
    ],
)
async def test_too_much_is_refused_with_the_ceiling(
    connect_service: ConnectService, options: dict[str, Any], pointer: str, allowed: int
) -> None:
    async with connect_service() as (http, service):
        body = {"dataset_id": await committed_dataset(service), "options": options}
        assert ceiling(await http.post("/v1/jobs", json=body)) == (pointer, allowed)
        assert ceiling(await http.post("/v1/estimates", json={"options": options})) == (pointer, allowed)


async def test_job_limits_apply_to_retries_and_renders(connect_service: ConnectService) -> None:
    async with connect_service(max_iterations=50, max_render_pixels=19_999) as (http, service):
        dataset = await photographed_dataset(service, 100, 50, 4)
        body = {"dataset_id": dataset, "options": {"train": {"iterations": 51}}}
        assert ceiling(await http.post("/v1/jobs", json=body)) == ("#/options/train/iterations", 50)
        body["options"] = {"train": {"iterations": 50}}
        job = (await http.post("/v1/jobs", json=body)).json()
        schema = (await http.get("/v1/options/reconstruct")).json()
        assert schema["ceilings"]["train.iterations"] == 50 and schema["ceilings"]["max_side"] == 16_384
        page = (await http.get("/new")).text
        assert 'id="reconstruct-train-iterations"' in page and 'max="50"' in page
        attempt = await claim_job(service, job)
        await attempt.fail({"type": "x", "message": "x."}, [ResultFile("scene.ply", "a" * 64, 1, "x/y")])
        retry = {"from": "start", "options": {"train": {"iterations": 60}}}
        again = await http.post(f"/v1/jobs/{job['id']}/retry", json=retry)
        assert ceiling(again) == ("#/options/train/iterations", 50)
        for options, pointer in (
            ({"frames": 10, "width_px": 100, "height_px": 100}, "#/options/frames"),
            ({"mode": "views", "format": "png"}, "#/options/max_side"),
        ):
            render = {"kind": "render", "source_id": job["id"], "options": options}
            assert ceiling(await http.post("/v1/jobs", json=render)) == (pointer, 19_999)
        render["options"] = {"mode": "views", "format": "png", "max_side": 99}
        assert (await http.post("/v1/jobs", json=render)).status_code == 202


async def test_high_priorities_are_for_administrators(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        writer = await client_with_token(service, "me", "write")
        admin = await client_with_token(service, "boss", "admin")
        mine = {"kind": "toy", "dataset_id": await committed_dataset(service, "me")}
        for who, priority, status in (
            (writer, 10, 202),
            (writer, 11, 422),
            (admin, 100, 202),
            (writer, -100, 202),
        ):
            answer = await http.post("/v1/jobs", json={**mine, "priority": priority}, headers=who)
            assert answer.status_code == status, answer.text
            if status == 422:
                assert ceiling(answer) == ("#/priority", 10)


async def test_job_estimate_before_and_at_creation_match(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        async with service.pool.connection() as connection:
            facts = {"threads": 4, "memory_limit_bytes": 400_000_000}
            await record_worker_heartbeat(
                connection, uuid.uuid4(), name="w", queues=["cpu"], slots=2, facts=facts
            )

        async def estimate(options: dict[str, Any], **body: Any) -> dict[str, Any]:
            answer = await http.post("/v1/estimates", json={"options": options, **body})
            assert answer.status_code == 200, answer.text
            found: dict[str, Any] = answer.json()["estimate"]
            return found

        fast = await estimate({"preset": "fast"}, photographs=PHOTOGRAPHS)
        # Within a factor of two of what was measured for fox: 88 s of both cores.
        assert 44 < fast["cpu_seconds"] < 176 and fast["cores"] == 2
        assert fast["cpu_seconds"] / 2 < fast["seconds"] < fast["cpu_seconds"]
        assert "on 2 cores and" in fast["text"] and not fast["finds_poses"]
        for changes, more in (
            ({"train": {"iterations": 4000}}, "cpu_seconds"),
            ({"train": {"rays_per_batch": 32_768}}, "cpu_seconds"),
            ({"train": {"max_gaussians": 80_000}}, "cpu_seconds"),
            ({"train": {"max_gaussians": 1_000_000}}, "memory_bytes"),
            ({"train": {"rays_per_batch": 200_000}}, "memory_bytes"),
        ):
            other = await estimate({"preset": "fast", **changes}, photographs=PHOTOGRAPHS)
            assert other[more] > 1.2 * fast[more], changes
        large = [{"width_px": 4000, "height_px": 3000, "count": 50}]
        assert (await estimate({"preset": "fast"}, photographs=large))["memory_bytes"] > fast["memory_bytes"]
        assert (await estimate({"poses": "auto"}, photographs=large))["finds_poses"]
        assert await estimate({"preset": "fast"}) is None  # of what?
        dataset = await photographed_dataset(service, 269, 480, 50)
        assert await estimate({"preset": "fast"}, dataset_id=dataset) == fast
        job = (
            await http.post("/v1/jobs", json={"dataset_id": dataset, "options": {"preset": "fast"}})
        ).json()
        assert job["estimate"] == fast
        assert [note for note in job["notes"] if "its workers allow 0.4 GB" in note]
        assert fast["text"] in (await http.get(f"/jobs/{job['id']}")).text
        stranger = await client_with_token(service, "stranger", "write")
        for name, thing in (("dataset_id", dataset), ("source_id", job["id"])):
            answer = await http.post("/v1/estimates", json={name: thing}, headers=stranger)
            assert answer.status_code == 422 and answer.json()["errors"][0]["pointer"] == f"#/{name}"


async def test_job_exceeding_workspace_limit_is_refused(connect_service: ConnectService) -> None:
    """Within the ceiling of pixels, and still more than a job's folder may take."""

    async with connect_service(max_workspace_bytes=4 << 30) as (http, service):
        dataset = await photographed_dataset(service, 64, 48, 3)
        job = (await http.post("/v1/jobs", json={"dataset_id": dataset, "kind": "reconstruct"})).json()
        attempt = await claim_job(service, job)
        await attempt.succeed([ResultFile("scene.ply", "a" * 64, 1, "text/plain")])
        pictures = {"frames": 1000, "width_px": 1024, "height_px": 1024}
        body = {"kind": "render", "source_id": job["id"], "options": {**pictures, "format": "exr"}}
        assert ceiling(await http.post("/v1/jobs", json=body)) == ("#/options/format", 4 << 30)
        body["options"]["format"] = "png"
        answer = await http.post("/v1/jobs", json=body)
        assert answer.status_code == 202 and answer.json()["estimate"]["disk_bytes"] > 4e8, answer.text


async def test_job_too_large_for_every_worker_is_refused(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await photographed_dataset(service, 64, 48, 3)
        job = (await http.post("/v1/jobs", json={"dataset_id": dataset, "kind": "reconstruct"})).json()
        attempt = await claim_job(service, job)
        await attempt.succeed([ResultFile("scene.ply", "a" * 64, 1, "text/plain")])
        images = {"frames": 900, "width_px": 2048, "height_px": 2048, "format": "exr"}
        render = {"kind": "render", "source_id": job["id"], "options": images}
        training = {"dataset_id": dataset, "options": {"train": {"max_gaussians": 4_000_000}}}
        waiting = await http.post("/v1/jobs", json=render)  # a worker may come that has more
        assert waiting.status_code == 202
        facts = {"disk_bytes": 10 << 30, "memory_limit_bytes": 1 << 30}
        await worker_reports(service, "small", facts)
        for body, resource in ((render, "disk"), (training, "memory")):
            refused = await http.post("/v1/jobs", json=body)
            assert refused.status_code == 422, refused.text
            assert refused.json()["type"] == "urn:octasplat:problem:too-large"
            assert resource in refused.json()["detail"] and "the queue cpu" in refused.json()["detail"]
        cancelled = await http.post(f"/v1/jobs/{waiting.json()['id']}/cancel")
        assert cancelled.status_code in (200, 202), cancelled.text
        retried = await http.post(f"/v1/jobs/{waiting.json()['id']}/retry")
        assert retried.status_code == 422, retried.text
        await worker_reports(service, "large", {"disk_bytes": 1 << 40, "memory_limit_bytes": 1 << 40})
        for body in (render, training):
            assert (await http.post("/v1/jobs", json=body)).status_code == 202


async def worker_reports(service: Service, name: str, facts: dict[str, Any]) -> None:
    async with service.pool.connection() as connection:
        await record_worker_heartbeat(
            connection, uuid.uuid4(), name=name, queues=["cpu"], slots=1, facts=facts
        )


async def test_notes_tell_why_jobs_wait_and_were_begun_anew(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):

        async def notes_of(job: dict[str, Any]) -> list[str]:
            found: list[str] = (await http.get(f"/v1/jobs/{job['id']}")).json()["notes"]
            return found

        body = {"dataset_id": await committed_dataset(service)}
        first, second = [(await http.post("/v1/jobs", json=body)).json() for _ in range(2)]
        await worker_reports(service, "w", {})
        assert await notes_of(first) == []
        async with service.pool.connection() as connection, connection.transaction():
            row = await get_job(connection, uuid.UUID(first["id"]), lock=True)
            assert row is not None
            reason = "It needs 9 bytes of disk, and /srv/data/octasplat/work has 5."
            await requeue_job(connection, service.job_queue, row, without_event=True, reason=reason)
        assert await notes_of(first) == ["It needs 9 bytes of disk, and …/octasplat/work has 5."]
        attempt = await claim_job(service, first)
        assert await notes_of(first) == []
        await attempt.record_begun_anew("The checkpoint is of another version, so the job begins anew.")
        assert await notes_of(first) == ["The checkpoint is of another version, so the job begins anew."]
        assert await notes_of(second) == [
            "The workers of the queue cpu do as many jobs as they can at once (1)."
        ]
