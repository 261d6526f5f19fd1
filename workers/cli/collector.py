"""Garbage collection while a command starts."""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_OBJECTS_AT_START = 100_000
"""So many new objects lead to a collection while modules are imported, in place of some hundreds."""


@contextmanager
def rare_collections() -> Iterator[Callable[[], None]]:
    """Collect garbage rarely until the block ends, or until what it gives is called.

    Imported modules make many objects, which stay. To look through them again and again takes a tenth of the
    time of a small picture.
    """
    usual = gc.get_threshold()
    gc.set_threshold(_OBJECTS_AT_START, *usual[1:])

    def end() -> None:
        gc.set_threshold(*usual)

    try:
        yield end
    finally:
        end()
