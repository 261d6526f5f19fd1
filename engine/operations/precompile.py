"""Compile the kernels of a request in other processes, beside the parts of it that need none.

``kernel_signatures.json`` says which kernels each group of requests calls and with which arguments; it is
written by ``python -m benchmarks.kernel_signatures --write``. A kernel that is not in it is compiled when it
is called. This module imports no numba.
"""

import json
import os
import subprocess
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from octasplat.engine.core.isolated_python import python_command
from octasplat.engine.core.kernel_folder import count_code
from octasplat.engine.core.threads import available_threads

TABLE = Path(__file__).with_name("kernel_signatures.json")
FIRST_ITERATION = "first-iteration"
"""The group of what a reconstruction calls until the end of its first iterations."""
MAX_PROCESSES = 2
"""More compile the functions that kernels share once more each."""
MIN_SECONDS_BESIDE = 6.0
"""Below it, processes that first load the compiler would take more CPU time and end no earlier."""


class KernelSignature(NamedTuple):
    """A kernel and the types of arguments that it is called with.

    Attributes:
        module: of the kernel.
        function: its name.
        arguments: see :func:`octasplat.engine.core.kernel_signatures.encode_type`.
        seconds: that one core of the machine on which the table was written took to compile it.
    """

    module: str
    function: str
    arguments: tuple[Any, ...]
    seconds: float


@cache
def _table() -> tuple[tuple[KernelSignature, ...], dict[str, tuple[int, ...]]]:
    content = json.loads(TABLE.read_text(encoding="utf-8"))
    kernels = tuple(
        KernelSignature(k["module"], k["function"], tuple(k["arguments"]), k["seconds"])
        for k in content["kernels"]
    )
    return kernels, {name: tuple(numbers) for name, numbers in content["groups"].items()}


def kernel_groups() -> tuple[str, ...]:
    """Return the names of all groups; :data:`FIRST_ITERATION` is a part of the reconstruction's."""
    return tuple(name for name in _table()[1] if name != FIRST_ITERATION)


def kernels_of(groups: Sequence[str]) -> tuple[KernelSignature, ...]:
    """Return the kernels of the groups in the order in which they are called; unknown groups have none."""
    return tuple(found for kernels in kernels_by_group(groups) for found in kernels)


def kernels_by_group(groups: Sequence[str]) -> tuple[tuple[KernelSignature, ...], ...]:
    """Return the kernels of each group that no group before it has, in the order in which they are called."""
    kernels, numbers = _table()
    seen: set[int] = set()
    found = []
    for group in groups:
        wanted = [number for number in numbers.get(group, ()) if number not in seen]
        seen.update(wanted)
        found.append(tuple(kernels[number] for number in wanted))
    return tuple(found)


def request_groups(operation: str, request: Any) -> tuple[str, ...]:
    """Return the groups of kernels that a request, or its options, of an operation calls."""
    if operation == "render" and getattr(request, "stage", None):
        return ("render-stage",)
    if operation == "reconstruct":
        return (FIRST_ITERATION, operation)
    return (operation,)


def missing_kernels(groups: Sequence[str]) -> tuple[KernelSignature, ...]:
    """Return those kernels of the groups of which code is kept for too few types of arguments, or none."""
    wanted = kernels_of(groups)
    counts = Counter((found.module, found.function) for found in wanted)
    kept = {kernel: count_code(*kernel) for kernel in counts}
    return tuple(
        found for found in wanted if kept[found.module, found.function] < counts[found.module, found.function]
    )


def cold_start_seconds(groups: Sequence[str]) -> float:
    """Return how long one core compiles what is missing, measured where the table was written."""
    return sum(found.seconds for found in missing_kernels(groups))


def start_compiling(groups: Sequence[str], processes: int = 1) -> list[subprocess.Popen[bytes]]:
    """Start processes that compile the kernels of the groups; each takes those that no other one does."""
    return [
        subprocess.Popen(  # noqa: S603 - a program of ours
            python_command("octasplat.engine.operations.precompile_main", str(number), *groups),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "OMP_NUM_THREADS": "1"},  # kernels get no threads of BLAS beside them
        )
        for number in range(processes)
    ]


def compile_now(groups: Sequence[str]) -> None:
    """Compile what is missing of the groups in other processes, and wait for these."""
    with _ended(start_compiling(groups, min(MAX_PROCESSES, available_threads()))) as started:
        for process in started:
            process.wait()


@contextmanager
def compile_beside(groups: Sequence[str]) -> Iterator[None]:
    """Compile what is missing of the groups in processes beside this one, which are ended with the context.

    Where there is one core, or little is missing, this process compiles what it calls by itself.
    """
    count = min(MAX_PROCESSES, available_threads())
    is_worth_it = count > 1 and cold_start_seconds(groups) > MIN_SECONDS_BESIDE
    with _ended(start_compiling(groups, count) if is_worth_it else []):
        yield


@contextmanager
def _ended(processes: list[subprocess.Popen[bytes]]) -> Iterator[list[subprocess.Popen[bytes]]]:
    """End the processes with the context; what they have kept by then stays."""
    try:
        yield processes
    finally:
        # killed at once: what is compiled is kept, and nothing else is written
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()
