"""What errors of the operating system mean for a store."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from engine.files import NO_ROOM
from workers.store.errors import StorageFull, StorageUnavailable


@contextmanager
def told(path: Path) -> Iterator[None]:
    """Turn the errors of the operating system, met while using ``path``, into those of a store.

    Raises:
        StorageFull: the disk is full.
        StorageUnavailable: everything else.
    """
    try:
        yield
    except OSError as error:
        if error.errno in NO_ROOM:
            raise StorageFull(f"The disk of {path} is full; delete datasets or jobs, or add room.") from error
        reason = error.strerror or str(error)
        raise StorageUnavailable(
            f"{path} cannot be used ({reason}); check its disk and its access."
        ) from error
