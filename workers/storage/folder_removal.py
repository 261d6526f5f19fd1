"""Removal of folders that an untrusted program has written, however deep they are or shut to their owner."""

import os
import uuid
from contextlib import suppress
from pathlib import Path

from octasplat.workers.storage.untrusted_folder import MAX_DEPTH

_FOLDER = os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


def remove_folder(path: Path) -> None:
    """Remove a folder and all that is in it, without following links; what cannot be removed stays."""
    with suppress(OSError):
        top = _open_folder(str(path), None)
        try:
            while _empty(top, top, 0):
                pass
        finally:
            os.close(top)
        path.rmdir()


def _empty(folder: int, top: int, depth: int) -> bool:
    """Remove what is in a folder; return whether deeper folders were moved to the top for another round."""
    with os.scandir(folder) as entries:
        found = [(entry.name, entry.is_dir(follow_symlinks=False)) for entry in entries]
    moved = False
    for name, is_folder in found:
        with suppress(OSError):
            if not is_folder:
                os.unlink(name, dir_fd=folder)
                continue
            inner = _open_folder(name, folder)
            try:
                # To the top, as each depth takes a descriptor and a part of the stack.
                if depth == MAX_DEPTH:
                    os.rename(name, uuid.uuid4().hex, src_dir_fd=folder, dst_dir_fd=top)
                    moved = True
                    continue
                moved |= _empty(inner, top, depth + 1)
            finally:
                os.close(inner)
            os.rmdir(name, dir_fd=folder)
    return moved


def _open_folder(name: str, parent: int | None) -> int:
    """Open a folder for reading, also one whose owner has shut it to itself.

    Raises:
        OSError: it is none, or somebody else's.
    """
    try:
        found = os.open(name, os.O_RDONLY | _FOLDER, dir_fd=parent)
        if os.fstat(found).st_mode & 0o700 == 0o700:
            return found
        os.close(found)
    except PermissionError:
        if not hasattr(os, "O_PATH"):
            raise
    # By a descriptor that needs no access, as a name could be that of a link by then.
    handle = os.open(name, getattr(os, "O_PATH", os.O_RDONLY) | _FOLDER, dir_fd=parent)
    try:
        os.chmod(f"/proc/self/fd/{handle}", 0o700)  # noqa: PTH101 - a descriptor, by its only name
        return os.open(name, os.O_RDONLY | _FOLDER, dir_fd=parent)
    finally:
        os.close(handle)
