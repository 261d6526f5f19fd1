"""What monitoring sees: true numbers, counters that never fall, and no ids."""

import re
import uuid
from typing import Any

import httpx
from prometheus_client.parser import text_string_to_metric_families

from octasplat.workers.db.ids import new_id
from octasplat.workers.db.workers import record_worker_heartbeat
from octasplat.workers.queue.recovery import StalledAttempts, recover_stalled_jobs
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    client_with_token,
    committed_dataset,
)

PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c49444154789c63f8cfc000000301010018dd8d"
    "b00000000049454e44ae426082"
)


async def read(http: httpx.AsyncClient, **headers: str) -> dict[str, float]:
    """Values by name and labels, as Prometheus would read them."""
    answer = await http.get("/metrics", headers=headers)
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/plain; version=")
    assert not re.search(r"[0-9a-f]{8}-[0-9a-f]{4}-|[0-9a-f]{32}", answer.text), "an id"
    return {
        sample.name + "".join(f"[{value}]" for value in sample.labels.values()): sample.value
        for family in text_string_to_metric_families(answer.text)
        for sample in family.samples
    }


async def new_job(http: httpx.AsyncClient, dataset: str, **more: Any) -> dict[str, Any]:
    answer = await http.post("/v1/jobs", json={"kind": "toy", "dataset_id": dataset, **more})
    job: dict[str, Any] = answer.json()
    return job


async def test_metrics_equal_table_counts(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        before = await read(http)
        assert before["octasplat_queue_depth[cpu]"] == before["octasplat_job_attempts_total"] == 0
        assert "octasplat_job_heartbeat_age_seconds" not in before and before["octasplat_workers"] == 0
        assert before["octasplat_storage_free_bytes"] > 0 and before["process_resident_memory_bytes"] > 1e6
        dataset = await committed_dataset(service)
        jobs = [await new_job(http, dataset) for _ in range(4)] + [
            await new_job(http, dataset, queue="large")
        ]
        async with service.pool.connection() as connection:
            await record_worker_heartbeat(
                connection, new_id(), name="w", queues=["cpu", "large"], slots=3, facts={}
            )
            await connection.execute("UPDATE workers SET seen_at = now() - interval '7 seconds'")
            await connection.execute("UPDATE jobs SET queued_at = now() - interval '90 seconds'")
        first = await claim_job(service, jobs[0])
        await claim_job(service, jobs[1])
        await (await claim_job(service, jobs[2])).succeed([])
        async with service.pool.connection() as connection:
            await connection.execute(
                "UPDATE jobs SET heartbeat_at = now() - interval '9 s' WHERE state = 'running'"
            )
        seen = await read(http)
        assert (seen["octasplat_queue_depth[cpu]"], seen["octasplat_queue_depth[large]"]) == (1, 1)
        assert 89 < seen["octasplat_queue_oldest_seconds[cpu]"] < 120
        assert (seen["octasplat_jobs_running[cpu]"], seen["octasplat_jobs_running[large]"]) == (2, 0)
        assert (seen["octasplat_worker_slots[cpu]"], seen["octasplat_workers"]) == (3, 1)
        assert 6.9 < seen["octasplat_worker_heartbeat_age_seconds"] < 19
        assert 8.9 < seen["octasplat_job_heartbeat_age_seconds"] < 30
        assert seen["octasplat_job_attempts_total"] == 3
        assert seen["octasplat_jobs_finished_total[succeeded]"] == 1
        await first.cancel()
        assert (await read(http))["octasplat_jobs_finished_total[canceled]"] == 1


async def test_recovery_counters_outlive_job(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        job = await new_job(http, await committed_dataset(service))
        for _ in range(4):
            await claim_job(service, job)
            async with service.pool.connection() as connection:
                await connection.execute("UPDATE jobs SET heartbeat_at = now() - interval '1 hour'")
            assert await recover_stalled_jobs(service.pool, service.job_queue, 20, StalledAttempts(0.0)) == 1
        assert (await http.get(f"/v1/jobs/{job['id']}")).json()["state"] == "failed"
        assert (await http.delete(f"/v1/jobs/{job['id']}")).status_code == 204
        seen = await read(http)
        assert (seen["octasplat_job_attempts_total"], seen["octasplat_job_rescues_total"]) == (4, 3)
        assert seen["octasplat_job_poisoned_total"] == seen["octasplat_jobs_finished_total[failed]"] == 1


async def test_upload_and_webhook_counters(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        dataset = (await http.post("/v1/datasets", json={})).json()["id"]
        answer = await http.put(f"/v1/datasets/{dataset}/files/images/a.png", content=PNG)
        assert answer.status_code == 201, answer.text
        hook = (await http.post("/v1/webhooks", json={"url": "https://example.org/"})).json()["id"]
        await http.post(f"/v1/webhooks/{hook}/test")
        seen = await read(http)
        assert seen["octasplat_upload_bytes_total"] == len(PNG)
        assert (seen["octasplat_webhook_messages[pending]"], seen["octasplat_webhook_messages[failed]"]) == (
            1,
            0,
        )


async def test_metrics_require_token(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        monitor = await client_with_token(service, f"u{uuid.uuid4().hex[:5]}", "metrics")
        assert (await http.get("/metrics", headers={"Authorization": ""})).status_code == 401
        assert await read(http, **monitor)
