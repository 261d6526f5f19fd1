"""Compilation of the kernels, and the cache of their machine code.

Three rules keep the first use of the program short:

- A function that only other kernels call is a :func:`device_function`: it is typed and lowered, and its code
  is generated as part of its callers. It has no wrapper for Python and no machine code of its own.
- A loop over threads whose body is long is a :func:`kernel` that each thread calls (:func:`run_on_threads`).
  Numba's ``prange`` would generate the code of its body three times.
- Machine code is kept by the content of the sources that it is made of, see
  :mod:`octasplat.engine.core.kernel_cache`.
"""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from numba import njit, types
from numba.core.compiler import Compiler

from octasplat.engine.core.kernel_cache import share_compilation

ROWS = 256
"""Rows of an array that are worth a thread: fewer take less time than to wake it."""


class _DeviceCompiler(Compiler):  # type: ignore[misc]
    """Types and lowers a function for its callers; makes neither wrappers nor machine code.

    The callers' module takes the code in and optimises all of it once.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        flags = self.state.flags
        flags.no_compile = True
        flags.no_cpython_wrapper = True
        flags.no_cfunc_wrapper = True

    def compile_extra(self, func: Any) -> Any:
        context = self.state.targetctx
        library = context.codegen().create_library(func.__qualname__)
        library._optimize_final_module = lambda: None
        self.state.library = library
        result = super().compile_extra(func)
        # Callers find the code by the identity of a builtin. This one is new, and raises whatever it is
        # called with, as the format asks for a value that nobody gives.
        entry = f"{{{func.__name__} is called by kernels only, not from Python}}".format
        context.insert_user_function(entry, result.fndesc, [result.library])
        return result._replace(entry_point=entry)


def device_function(**options: Any) -> Callable[[Any], Any]:
    """Return a decorator for functions that kernels call and Python does not.

    Args:
        options: as of ``numba.njit``.
    """
    compiled = njit(pipeline_class=_DeviceCompiler, **options)
    return lambda function: _with_plain_integers(compiled(function))


def _with_plain_integers(dispatcher: Any) -> Any:
    """Type calls of a device function with ``int64`` for each literal integer; return the function.

    Numba would compile it once for each literal, and once more for a variable that begins as one.
    """
    call_template: Callable[[Any, Any], Any] = dispatcher.get_call_template

    def plain(argument: Any) -> Any:
        return types.unliteral(argument) if isinstance(argument, types.IntegerLiteral) else argument

    def plain_call_template(arguments: Any, keywords: Any) -> Any:
        keywords = {name: plain(argument) for name, argument in keywords.items()}
        return call_template(tuple(map(plain, arguments)), keywords)

    dispatcher.get_call_template = plain_call_template
    return dispatcher


def kernel(**options: Any) -> Callable[[Any], Any]:
    """Return a decorator for functions that Python calls; options as of ``numba.njit``.

    Their machine code is kept on the disk, see :mod:`octasplat.engine.core.kernel_cache`. They release the
    interpreter's lock.
    """
    compiled = njit(cache=True, nogil=True, no_cfunc_wrapper=True, **options)
    return lambda function: share_compilation(compiled(function))


class _Threads:
    """Pool of waiting threads; as many as were ever requested at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._count = 0
        # A forked child has none of these threads, and its copy of the lock may be held for good.
        os.register_at_fork(after_in_child=self._forget)

    def _forget(self) -> None:
        self._lock, self._pool, self._count = threading.Lock(), None, 0

    def pool(self, count: int) -> ThreadPoolExecutor:
        with self._lock:
            if self._pool is None or self._count < count:
                # Calls on a smaller pool end there; its threads stop once nothing refers to it.
                self._pool, self._count = ThreadPoolExecutor(count, "kernel"), count
            return self._pool


_THREADS = _Threads()


def _call_all(kernel: Callable[..., None], calls: Sequence[tuple[Any, ...]]) -> None:
    """Make all calls at once, the first on this thread; wait for all, then raise the first error."""
    pool = _THREADS.pool(len(calls) - 1) if len(calls) > 1 else None
    others = [pool.submit(kernel, *arguments) for arguments in calls[1:]] if pool else []
    try:
        kernel(*calls[0])
    finally:
        # exception() waits: no call may still write into the arrays when an error reaches the caller.
        errors = [error for error in (other.exception() for other in others) if error is not None]
    if errors:
        raise errors[0]


def run_on_threads(kernel: Callable[..., None], threads: int, *arguments: Any) -> None:
    """Call ``kernel(*arguments)`` on ``threads`` threads at once, this one among them; wait for all.

    The calls share their work by a counter among the arguments
    (:func:`octasplat.engine.trace.kernels.native.atomic_fetch_next`).

    Raises:
        Exception: what the first call that failed raised.
    """
    _call_all(kernel, [arguments] * max(1, threads))


def run_ranges(
    kernel: Callable[..., None], threads: int, count: int, *arguments: Any, grain: int = ROWS
) -> None:
    """Call ``kernel(first, last, *arguments)`` on ``threads`` threads, which share the range to ``count``.

    Args:
        kernel: works on the elements ``first`` to ``last``, each by itself.
        threads: how many to take at most.
        count: of the elements; each thread gets an equal share of neighbours.
        arguments: handed on.
        grain: elements that are worth a thread.

    Raises:
        Exception: what the first call that failed raised.
    """
    threads = max(1, min(threads, count // grain))
    ends = [count * k // threads for k in range(threads + 1)]
    _call_all(kernel, [(*ends[k - 1 : k + 1], *arguments) for k in range(1, threads + 1)])
