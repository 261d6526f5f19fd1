"""What is known of kernels being compiled in this process: which events report it, and how long it took.

This module imports no numba.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from octasplat.engine.core.events import Event, EventListener, KernelsCompiled, Noted

MESSAGE = "Compiling kernels (first run after an installation)."
_LOCK = threading.Lock()
_LISTENERS: list[EventListener] = []
_under_way = 0
_began = 0.0
_seconds = 0.0


def begin_compilation() -> None:
    """Note that a kernel is compiled from now on; kernels within it count as part of it."""
    global _under_way, _began
    with _LOCK:
        _under_way += 1
        if _under_way > 1:
            return
        _began = time.monotonic()
    # After the lock is released: a listener may ask for compilation_seconds().
    _tell(Noted(MESSAGE))


def end_compilation() -> None:
    """End what :func:`begin_compilation` began."""
    global _under_way, _seconds
    with _LOCK:
        _under_way -= 1
        if _under_way > 0:
            return
        seconds = time.monotonic() - _began
        _seconds += seconds
    _tell(KernelsCompiled(seconds))


def compilation_seconds() -> float:
    """Return how long this process compiled kernels, or waited for another one that did, so far."""
    with _LOCK:
        return _seconds


def _tell(event: Event) -> None:
    with _LOCK:
        listeners = tuple(_LISTENERS)
    for listener in listeners:
        listener(event)


@contextmanager
def report_compilation(progress: EventListener) -> Iterator[None]:
    """Tell ``progress`` once that kernels are compiled, and how long each time, within this context."""
    reported: set[type[Event]] = set()

    def tell(event: Event) -> None:
        if isinstance(event, KernelsCompiled) or Noted not in reported:
            reported.add(type(event))
            progress(event)

    with _LOCK:
        _LISTENERS.append(tell)
    try:
        yield
    finally:
        with _LOCK:
            _LISTENERS.remove(tell)
