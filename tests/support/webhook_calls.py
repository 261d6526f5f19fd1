"""Webhooks of a service under test: made, sent, and their deliveries."""

from typing import Any

import httpx

from octasplat.service.state import Service
from octasplat.workers.db.connections import Pool
from octasplat.workers.maintenance.webhooks.sender import WebhookSender
from tests.support.webhook_receiver import WebhookReceiver

HERE = ("127.0.0.1",)
"""Hosts that the service may send to."""


async def send_due(pool: Pool, allowed_hosts: tuple[str, ...] = ()) -> int:
    """Send what is due, until nothing is; returns how many messages, whether they arrived or not."""
    sender = WebhookSender(pool, allowed_hosts)
    begun = 0
    try:
        while (due := await sender.start_due()) or sender.sent_count < begun:
            begun += due
            await sender.wait()
        return sender.sent_count
    finally:
        await sender.close()


async def make_webhook(http: httpx.AsyncClient, receiver: WebhookReceiver, **more: Any) -> dict[str, Any]:
    answer = await http.post("/v1/webhooks", json={"url": receiver.url, **more})
    assert answer.status_code == 201, answer.text
    made: dict[str, Any] = answer.json()
    assert answer.headers["Location"] == f"/v1/webhooks/{made['id']}"
    return made


async def deliveries(http: httpx.AsyncClient, hook: dict[str, Any]) -> list[dict[str, Any]]:
    answer = await http.get(f"/v1/webhooks/{hook['id']}/deliveries")
    found: list[dict[str, Any]] = answer.json()["deliveries"]
    return found


async def make_due(service: Service) -> None:
    """Let the wait for the next try be over."""
    async with service.pool.connection() as connection:
        await connection.execute("UPDATE webhook_deliveries SET due_at = now() WHERE state = 'pending'")
