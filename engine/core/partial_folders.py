"""Folders for what is being written, beside its place; those that killed processes left are removed."""

import errno
import fcntl
import os
import re
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_LOCKED_ERRORS = frozenset({errno.EAGAIN, errno.EACCES})
_NAME = re.compile(r"\..+\.\d+\.[0-9a-f]{8}\.partial")
_MOST_NAME_CHARACTERS = 40
"""Of the name of what is written, as names of files have at most 255 bytes."""


class FolderLockedError(Exception):
    """Another process, or another part of this one, holds the lock of a folder."""


def lock_folder(folder: Path) -> tuple[int, bool]:
    """Lock a folder itself, without a file in it, until what is returned is closed or the process ends.

    Returns:
        A descriptor of the folder, and whether it is locked: not on a file system without locks.

    Raises:
        FolderLockedError: somebody else has the lock.
        OSError: it is no folder, or cannot be opened.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _LOCKED_ERRORS:
            return handle, False
        os.close(handle)
        raise FolderLockedError from None
    return handle, True


@contextmanager
def partial_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder beside ``path`` for what is being written there; it is removed when the block ends.

    In the block it may be renamed to ``path``. What processes that were killed have left beside ``path``, for
    whichever files, is removed first: folders of such names whose lock nobody holds. On a file system without
    locks they stay.

    Raises:
        OSError: the folder cannot be made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_abandoned(path.parent)
    name = path.name[:_MOST_NAME_CHARACTERS]
    handle: int | None = None
    folder = path
    try:
        while handle is None:
            folder = path.with_name(f".{name}.{os.getpid()}.{uuid.uuid4().hex[:8]}.partial")
            folder.mkdir()
            # Another process may take it for an abandoned one until it is locked.
            with suppress(FolderLockedError, FileNotFoundError):
                handle, _ = lock_folder(folder)
            if handle is not None and not folder.exists():
                os.close(handle)
                handle = None
        yield folder
    finally:
        # In here from the start, as a signal may end the program as soon as the folder is there.
        if folder != path:
            shutil.rmtree(folder, ignore_errors=True)
        if handle is not None:
            os.close(handle)


def _remove_abandoned(parent: Path) -> None:
    """Remove the partial folders in a folder whose processes are gone."""
    with suppress(OSError):
        for left in [path for path in parent.iterdir() if _NAME.fullmatch(path.name)]:
            if left.is_symlink():
                continue
            with suppress(OSError, FolderLockedError):
                handle, is_locked = lock_folder(left)
                try:
                    if is_locked:
                        shutil.rmtree(left, ignore_errors=True)
                finally:
                    os.close(handle)
