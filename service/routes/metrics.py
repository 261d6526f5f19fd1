"""Metrics for Prometheus, which sends a token like everybody else (`authorization` in its settings)."""

import asyncio

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST

from service.auth import Reader
from service.routes import problems
from service.state import ServiceDep
from workers.queue.numbers import read_numbers
from workers.store.errors import StorageError
from workers.store.protocol import Storage

router = APIRouter(tags=["health"])


@router.get(
    "/metrics",
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}, **problems()},
    response_class=Response,
)
async def get_metrics(_who: Reader, service: ServiceDep) -> Response:
    """How the service fares, in the format of Prometheus."""
    async with service.pool.connection() as connection:
        numbers = await read_numbers(connection, service.settings.stale_seconds)
    free_bytes = await asyncio.to_thread(_free_bytes, service.storage)
    text = service.metrics.render(numbers, streams=service.hub.streams, free_bytes=free_bytes)
    return Response(text, headers={"Content-Type": CONTENT_TYPE_LATEST, "Cache-Control": "no-store"})


def _free_bytes(storage: Storage) -> int | None:
    try:
        return storage.free_bytes()
    except StorageError:
        return None  # readyz tells of it
