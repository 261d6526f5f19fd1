"""The end of tasks that run beside others."""

import asyncio
from collections.abc import Iterable
from typing import Any

RECANCEL_SECONDS = 5.0
"""What has not ended by then is cancelled once more; cleaning up takes less."""


async def cancel_and_wait(tasks: Iterable["asyncio.Future[Any]"]) -> list[BaseException | None]:
    """Cancel tasks until all have ended.

    Once is not enough: a cancellation that comes as what a task waits for ends may be lost on its way
    through ``asyncio.wait_for`` (Python before 3.12) or a library, and whoever waits would do so for ever.

    Returns:
        What each ended by, in their order; None where it had returned.
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
