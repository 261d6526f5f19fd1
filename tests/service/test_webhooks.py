"""Webhooks: sent for each change of a job, signed, retried for a day; seen and changed by their owner."""

import asyncio
import base64
import logging
import socket
import uuid
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from standardwebhooks.webhooks import Webhook, WebhookVerificationError

from octasplat.workers.db.connections import open_pool
from octasplat.workers.maintenance.webhooks.outbox import RETRY_DELAYS_SECONDS, lease_due, purge_deliveries
from octasplat.workers.maintenance.webhooks.sender import MAX_PER_OWNER, WebhookSender
from octasplat.workers.maintenance.webhooks.signing import signed_message
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    client_with_token,
    committed_dataset,
    new_job,
    running_service,
)
from tests.support.webhook_calls import HERE, deliveries, make_due, make_webhook, send_due
from tests.support.webhook_receiver import receive_webhooks

SECRET = "whsec_" + base64.b64encode(b"0123456789abcdef01234567").decode()


@pytest.fixture
def connect_service(conninfo: str, tmp_path: Path) -> ConnectService:
    """A service that may send to this machine."""
    return partial(running_service, conninfo, tmp_path, webhook_hosts=HERE)


async def test_webhook_of_finished_job_is_signed_and_minimal(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        with receive_webhooks() as receiver:
            hook = await make_webhook(http, receiver)
            job = await new_job(http, service, label="fox")
            assert await send_due(service.pool, HERE) == 0  # that it was queued is not asked for
            await (await claim_job(service, job)).fail({"type": "refused", "message": "a private path"})
            assert await send_due(service.pool, HERE) == 1
            assert await send_due(service.pool, HERE) == 0
        ((path, headers, body),) = receiver.received
        heard = Webhook(hook["secret"]).verify(body, headers)
        with pytest.raises(WebhookVerificationError):
            Webhook(hook["secret"]).verify(body.replace(b"failed", b"queued"), headers)
        with pytest.raises(WebhookVerificationError):
            Webhook(SECRET).verify(body, headers)
        assert (path, headers["content-type"]) == ("/hook", "application/json")
        assert heard["type"] == "job.failed"
        assert heard["data"] == {
            "job_id": job["id"], "kind": "toy", "label": "fox", "state": "failed", "attempt": 1
        }  # fmt: skip
        assert heard["timestamp"].endswith("Z") and b"private" not in body
        (told,) = await deliveries(http, hook)
        assert (told["state"], told["status"], told["tries"], told["due_at"]) == ("delivered", 204, 1, None)
        assert told["message_id"] == headers["webhook-id"] and told["payload"] == heard


async def test_webhook_of_rolled_back_change_is_not_sent(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        with receive_webhooks() as receiver:
            hook = await make_webhook(http, receiver, events=["job.canceling"])
            attempt = await claim_job(service, await new_job(http, service))
            async with service.pool.connection() as connection:
                with pytest.raises(RuntimeError):
                    async with connection.transaction():
                        await connection.execute(
                            "INSERT INTO job_events (job_id, attempt, kind, data) "
                            "VALUES (%s, 1, 'state', '{\"state\": \"canceling\"}')",
                            [attempt.job.id],
                        )
                        raise RuntimeError
            assert await deliveries(http, hook) == []
            assert (await http.post(f"/v1/jobs/{attempt.job.id}/cancel")).status_code == 202
            assert [told["kind"] for told in await deliveries(http, hook)] == ["job.canceling"]


async def test_webhook_of_one_job(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        with receive_webhooks() as receiver:
            hook = {"url": receiver.url, "secret": SECRET}
            job = await new_job(http, service, webhook=hook)
            await new_job(http, service)
            for listed in (await http.get("/v1/jobs")).json()["jobs"]:
                assert (await http.post(f"/v1/jobs/{listed['id']}/cancel")).status_code == 202
            await send_due(service.pool, HERE)
            ((_, headers, body),) = receiver.received
            assert Webhook(SECRET).verify(body, headers)["data"]["job_id"] == job["id"]
            (made,) = (await http.get("/v1/webhooks")).json()["webhooks"]
            assert made["job_id"] == job["id"] and "secret" not in made
            inner = {**hook, "url": "https://10.0.0.1/"}
            body_ = {"kind": "toy", "dataset_id": job["dataset_id"], "webhook": inner}
            answer = await http.post("/v1/jobs", json=body_)
            assert answer.status_code == 422 and answer.json()["errors"][0]["pointer"] == "#/webhook/url"
            assert (await http.delete(f"/v1/jobs/{job['id']}")).status_code == 204
            assert (await http.get("/v1/webhooks")).json()["webhooks"] == []


async def test_webhook_is_retried_for_a_day_with_same_message(connect_service: ConnectService) -> None:
    assert 23 * 3600 < sum(RETRY_DELAYS_SECONDS) <= 86_400 and list(RETRY_DELAYS_SECONDS) == sorted(
        RETRY_DELAYS_SECONDS
    )

    async with connect_service() as (http, service):
        with receive_webhooks(500) as receiver:
            hook = await make_webhook(http, receiver)
            assert (await http.post(f"/v1/webhooks/{hook['id']}/test")).status_code == 202
            for tries, wait in enumerate(RETRY_DELAYS_SECONDS, start=1):
                assert await send_due(service.pool, HERE) == 1
                (told,) = await deliveries(http, hook)
                assert (told["state"], told["tries"], told["status"]) == ("pending", tries, 500)
                async with service.pool.connection() as connection:
                    cursor = await connection.execute(
                        "SELECT extract(epoch FROM due_at - now())::float8 AS wait FROM webhook_deliveries"
                    )
                    row = await cursor.fetchone()
                assert row is not None and 0.95 * wait - 2 < row["wait"] <= 1.1 * wait
                await make_due(service)
            assert await send_due(service.pool, HERE) == 1
            (told,) = await deliveries(http, hook)
            assert (told["state"], told["due_at"]) == ("failed", None) and "500" in told["error"]
            receiver.statuses = [200]
            again = await http.post(f"/v1/webhooks/{hook['id']}/deliveries/{told['id']}/redeliver")
            assert again.status_code == 202 and again.json()["state"] == "pending"
            assert await send_due(service.pool, HERE) == 1
            assert (await deliveries(http, hook))[0]["state"] == "delivered"
            assert len(receiver.received) == len(RETRY_DELAYS_SECONDS) + 2
            assert len({(headers["webhook-id"], body) for _, headers, body in receiver.received}) == 1
            for _, headers, body in receiver.received:
                assert Webhook(hook["secret"]).verify(body, headers)["type"] == "webhook.test"


async def test_webhook_answering_410_is_disabled(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        with receive_webhooks(500, 410, 204) as receiver:
            hook = await make_webhook(http, receiver)
            address = f"/v1/webhooks/{hook['id']}"
            await http.post(f"{address}/test")
            await send_due(service.pool, HERE)
            await http.post(f"{address}/test")
            assert await send_due(service.pool, HERE) == 1
            seen = (await http.get(address)).json()
            assert not seen["enabled"] and "410" in seen["disabled_reason"]
            assert {told["state"] for told in await deliveries(http, hook)} == {"failed"}
            await (await claim_job(service, await new_job(http, service))).cancel()
            await make_due(service)
            assert await send_due(service.pool, HERE) == 0
            answer = await http.post(f"{address}/test")
            assert answer.status_code == 409 and answer.json()["type"].endswith("webhook-disabled")
            seen = (await http.patch(address, json={"enabled": True})).json()
            assert seen["enabled"] and seen["disabled_reason"] is None
            await http.post(f"{address}/test")
            assert await send_due(service.pool, HERE) == 1 and len(receiver.received) == 3


async def test_redirects_are_not_followed(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        with receive_webhooks(307) as receiver:
            hook = await make_webhook(http, receiver)
            await http.post(f"/v1/webhooks/{hook['id']}/test")
            await send_due(service.pool, HERE)
            assert [path for path, _, _ in receiver.received] == ["/hook"]
            assert (await deliveries(http, hook))[0]["status"] == 307


async def test_two_senders_share_and_a_lost_one_is_replaced(
    connect_service: ConnectService, conninfo: str
) -> None:
    async with connect_service() as (http, service):
        with receive_webhooks() as receiver:
            hook = await make_webhook(http, receiver)
            for _ in range(30):
                await http.post(f"/v1/webhooks/{hook['id']}/test")
            async with service.pool.connection() as connection:
                lost = await lease_due(connection, 5)  # and its sender dies
            assert len(lost) == 5
            async with open_pool(conninfo, max_size=4) as other:
                sent = await asyncio.gather(send_due(service.pool, HERE), send_due(other, HERE))
            assert sum(sent) == 25 == len({headers["webhook-id"] for _, headers, _ in receiver.received})
            await make_due(service)
            assert await send_due(service.pool, HERE) == 5
            assert len({headers["webhook-id"] for _, headers, _ in receiver.received}) == 30


async def test_dead_webhook_is_one_line_of_the_log(
    connect_service: ConnectService, caplog: pytest.LogCaptureFixture
) -> None:
    async with connect_service() as (http, service):
        with receive_webhooks(500, 500, 500, 204) as receiver:
            hook = await make_webhook(http, receiver)
            sender = WebhookSender(service.pool, HERE)
            caplog.set_level(logging.INFO, "octasplat.workers.maintenance.webhooks.sender")
            try:
                for sent in range(1, 5):
                    await http.post(f"/v1/webhooks/{hook['id']}/test")
                    await sender.start_due()
                    while sender.sent_count < sent:
                        await sender.wait()
            finally:
                await sender.close()
        lines = [record.message for record in caplog.records if hook["id"] in record.message]
        assert len(lines) == 2 and "500" in lines[0] and lines[1].endswith("takes messages again")


async def test_webhooks_are_visible_to_owner_only(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        mine = await client_with_token(service, "me", "write")
        other = await client_with_token(service, "stranger", "write")
        with receive_webhooks() as receiver:
            made = (await http.post("/v1/webhooks", json={"url": receiver.url}, headers=mine)).json()
            address = f"/v1/webhooks/{made['id']}"
            told = (await http.post(f"{address}/test", headers=mine)).json()
            again = f"{address}/deliveries/{told['id']}/redeliver"
            for method, path in [
                ("GET", address), ("PATCH", address), ("DELETE", address), ("POST", f"{address}/test"),
                ("GET", f"{address}/deliveries"), ("POST", again),
            ]:  # fmt: skip
                body = {"json": {}} if method == "PATCH" else {}
                assert (await http.request(method, path, headers=other, **body)).status_code == 404, path
            assert (await http.get("/v1/webhooks", headers=other)).json()["webhooks"] == []
            given = {"kind": "toy", "dataset_id": await committed_dataset(service, "me")}
            job = (await http.post("/v1/jobs", json=given, headers=mine)).json()
            spy = {"url": receiver.url, "job_id": job["id"]}
            assert (await http.post("/v1/webhooks", json=spy, headers=other)).status_code == 404
            await http.post("/v1/webhooks", json={"url": receiver.url}, headers=other)
            await http.post(f"/v1/jobs/{job['id']}/cancel", headers=mine)
            assert await send_due(service.pool, HERE) == 2  # the test and the owner's message
            assert (
                await http.post(f"{address}/deliveries/{uuid.uuid4()}/redeliver", headers=mine)
            ).status_code == 404
            assert (await http.delete(address, headers=mine)).status_code == 204
            assert (await http.get(address, headers=mine)).status_code == 404


@pytest.mark.parametrize(
    ("body", "pointer"),
    [
        ({"url": "http://example.org"}, "#/url"),
        ({"url": "https://example.org", "secret": "short"}, "#/secret"),
        ({"url": "https://example.org", "secret": "whsec_AAAA"}, "#/secret"),
        ({"url": "https://example.org", "events": []}, "#/events"),
        ({"url": "https://example.org", "events": ["job.exploded"]}, "#/events/0"),
    ],
)
async def test_webhook_invalid_request_is_refused(
    connect_service: ConnectService, body: dict[str, Any], pointer: str
) -> None:
    async with connect_service() as (http, _):
        answer = await http.post("/v1/webhooks", json=body)
        assert answer.status_code == 422
        assert answer.json()["errors"][0]["pointer"] == pointer


async def test_webhook_count_is_limited(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        body = {"url": "https://example.org/hook"}
        statuses = [(await http.post("/v1/webhooks", json=body)).status_code for _ in range(51)]
        assert statuses == [201] * 50 + [422]


async def test_webhook_slow_receiver_does_not_delay_other_owners(connect_service: ConnectService) -> None:
    """One whose address takes connections and never answers, and one whose address answers."""

    async with connect_service() as (http, service):
        slow, quick = (
            await client_with_token(service, "slow", "write"),
            await client_with_token(service, "quick", "write"),
        )
        with receive_webhooks() as receiver, socket.create_server(("127.0.0.1", 0), backlog=100) as silent:
            port = silent.getsockname()[1]
            for headers, url, messages in ((slow, f"http://127.0.0.1:{port}/", 60), (quick, receiver.url, 2)):
                answer = await http.post("/v1/webhooks", json={"url": url}, headers=headers)
                for _ in range(messages):
                    await http.post(f"/v1/webhooks/{answer.json()['id']}/test", headers=headers)
            sender = WebhookSender(service.pool, HERE)
            try:
                async with asyncio.timeout(60):
                    assert await sender.start_due() == MAX_PER_OWNER + 2
                    while len(receiver.received) < 2:
                        await asyncio.sleep(0.02)
                    assert await sender.start_due() == 0  # the slow one has all that it may
                    answer = await http.post("/v1/webhooks", json={"url": receiver.url}, headers=quick)
                    await http.post(f"/v1/webhooks/{answer.json()['id']}/test", headers=quick)
                    assert await sender.start_due() == 1
                    while len(receiver.received) < 3:
                        await asyncio.sleep(0.02)
            finally:
                await sender.close()


async def test_messages_of_paused_webhook_expire(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        with receive_webhooks() as receiver:
            hooks = [await make_webhook(http, receiver) for _ in range(2)]
            for hook in hooks:
                await http.post(f"/v1/webhooks/{hook['id']}/test")
            await http.patch(f"/v1/webhooks/{hooks[0]['id']}", json={"enabled": False})
            async with service.pool.connection() as connection:
                await connection.execute("UPDATE webhook_deliveries SET due_at = now() - interval '4 days'")
                await purge_deliveries(connection)
            paused, active = [(await deliveries(http, hook))[0] for hook in hooks]
            assert paused["state"] == "failed" and "paused" in paused["error"]
            assert active["state"] == "pending"


def test_documented_check_knows_genuine_messages() -> None:
    page = (Path(__file__).parents[2] / "docs" / "service.md").read_text(encoding="utf-8")
    (program,) = (block for block in page.split("```python\n") if "def is_genuine" in block)
    found: dict[str, Any] = {}
    exec(program.split("```")[0], found)
    is_genuine = found["is_genuine"]
    body, headers = signed_message(SECRET, uuid.uuid4(), {"type": "job.succeeded"}, datetime.now(UTC))
    assert is_genuine(SECRET, headers, body)
    assert not is_genuine(SECRET, headers, body + b" ")
    assert not is_genuine(SECRET, headers | {"webhook-timestamp": "1700000000"}, body)
