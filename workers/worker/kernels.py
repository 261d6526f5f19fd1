"""Kernels are compiled by the worker, as the processes of jobs may only read their machine code."""

import asyncio
import subprocess
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager

from octasplat.engine.core.compiling import MESSAGE
from octasplat.engine.operations.precompile import kernel_groups, missing_kernels, start_compiling

_POLL_SECONDS = 0.2


@asynccontextmanager
async def compile_in_background(
    groups: Sequence[str] | None = None,
) -> AsyncIterator[list["subprocess.Popen[bytes]"]]:
    """Compile what is missing of the groups, or of all, in a process beside, which ends with the context."""
    wanted = kernel_groups() if groups is None else groups
    missing = await asyncio.to_thread(missing_kernels, wanted)
    started = await asyncio.to_thread(start_compiling, wanted) if missing else []
    try:
        yield started
    finally:
        for process in started:
            process.kill()
            await asyncio.to_thread(process.wait)


async def compile_for_job(
    groups: Sequence[str], note: Callable[[str], None], should_stop: Callable[[], bool]
) -> None:
    """Compile what is missing of the kernels of a job, before its own process begins.

    Args:
        groups: of kernels.
        note: told that kernels are compiled, if any is missing.
        should_stop: asked meanwhile; True ends it.
    """
    async with compile_in_background(groups) as started:
        if started:
            note(MESSAGE)
        while any(process.poll() is None for process in started) and not should_stop():
            await asyncio.sleep(_POLL_SECONDS)
