"""Cancellation of tasks that run beside others."""

import asyncio
from collections.abc import Iterable
from typing import Any

RECANCEL_SECONDS = 5.0
"""What has not ended by then is cancelled once more; cleaning up takes less."""


async def cancel_and_wait(tasks: Iterable["asyncio.Future[Any]"]) -> list[BaseException | None]:
    """Cancel tasks until all have ended.

    A single cancellation is not enough: one that arrives just as the awaited operation ends may be lost in
    ``asyncio.wait_for`` (Python before 3.12) or in a library, and the caller would wait for ever.

    Returns:
        The exception that ended each task, in their order; None where it had returned.
    """
    ordered = list(tasks)
    left = set(ordered)
    while left:
        for task in left:
            task.cancel()
        _, left = await asyncio.wait(left, timeout=RECANCEL_SECONDS)
    return [_exception_of(task) for task in ordered]


def _exception_of(task: "asyncio.Future[Any]") -> BaseException | None:
    return asyncio.CancelledError() if task.cancelled() else task.exception()
