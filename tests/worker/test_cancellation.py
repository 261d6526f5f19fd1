"""Tasks end even where a cancellation was lost on its way."""

import asyncio

import pytest

from octasplat.workers import cancellation
from octasplat.workers.cancellation import cancel_and_wait


async def test_cancel_and_wait_repeats_lost_cancellation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cancellation, "RECANCEL_SECONDS", 0.05)
    lost = 0

    async def deaf() -> None:
        nonlocal lost
        while True:
            try:
                await asyncio.sleep(60)
            except asyncio.CancelledError:
                if lost == 2:
                    raise
                lost += 1

    async def fails() -> None:
        try:
            await asyncio.sleep(60)
        finally:
            raise ValueError("while cleaning up")

    async def returns() -> None:
        return

    tasks = [asyncio.create_task(work()) for work in (deaf, fails, returns)]
    await asyncio.sleep(0)
    async with asyncio.timeout(60):
        first, second, third = await cancel_and_wait(tasks)
    assert lost == 2 and isinstance(first, asyncio.CancelledError)
    assert isinstance(second, ValueError) and third is None
    assert await cancel_and_wait([]) == []
