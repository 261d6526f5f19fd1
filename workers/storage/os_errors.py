"""Translation of operating system errors into errors of the storage."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from octasplat.engine.core.writing import DISK_FULL_ERRORS
from octasplat.workers.storage.errors import StorageFullError, StorageUnavailableError

FREE_SPACE_HINT = "delete datasets or jobs, whose contents then go at once, or add room"


def is_disk_full(error: BaseException | None) -> bool:
    """Return whether an error, or its cause, is a full disk."""
    # Bounded, as causes may refer to each other.
    for _ in range(20):
        if error is None:
            return False
        if isinstance(error, StorageFullError) or (
            isinstance(error, OSError) and error.errno in DISK_FULL_ERRORS
        ):
            return True
        error = error.__cause__ or error.__context__
    return False


@contextmanager
def translate_os_errors(path: Path) -> Iterator[None]:
    """Turn the errors of the operating system, met while using ``path``, into those of a store.

    Raises:
        StorageFullError: the disk is full.
        StorageUnavailableError: everything else.
    """
    try:
        yield
    except OSError as error:
        if error.errno in DISK_FULL_ERRORS:
            raise StorageFullError(f"The disk of {path} is full; {FREE_SPACE_HINT}.") from error
        reason = error.strerror or str(error)
        raise StorageUnavailableError(
            f"{path} cannot be used ({reason}); check its disk and its access."
        ) from error
