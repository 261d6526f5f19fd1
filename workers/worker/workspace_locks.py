"""Locks of the folders of attempts and of their photographs, and the removal of those that nobody holds."""

import contextlib
import fcntl
import os
import shutil
import stat
import time
from pathlib import Path
from typing import IO

from octasplat.workers.storage.folder_removal import remove_folder

LOCK_FILE = ".lock"


def open_locked(path: Path, *, create: bool = True) -> IO[bytes]:
    """Open a file and hold its lock, which ends with this process."""
    # A program may have put a link in the place of the file.
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC | (os.O_CREAT if create else 0)
    handle = os.fdopen(os.open(path, flags, 0o600), "r+b")
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        handle.close()
        raise
    return handle


def lock_dataset_folder(folder: Path) -> IO[bytes]:
    """Make a folder of photographs and keep it from being swept for as long as the file is open."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):  # swept this moment
            handle = (folder / LOCK_FILE).open("ab")
            fcntl.flock(handle, fcntl.LOCK_SH)
            with contextlib.suppress(FileNotFoundError):
                # A sweep may have removed the file before its lock was taken, and a removed file protects
                # nothing.
                if os.path.samestat(os.fstat(handle.fileno()), (folder / LOCK_FILE).stat()):
                    return handle
            handle.close()


def sweep_workspaces(root: Path, dataset_seconds: float = 86_400.0) -> int:
    """Remove the folders of attempts whose worker is gone, and photographs not used for a while.

    Args:
        root: folder of all work on this machine.
        dataset_seconds: how long photographs stay that no attempt uses.

    Returns:
        Number of folders removed.
    """
    removed = 0
    for folder in (root / "attempts").glob("*"):
        try:
            lock = open_locked(folder / LOCK_FILE, create=False)
        except BlockingIOError:  # its worker is alive
            continue
        except OSError:
            try:
                age_seconds = time.time() - folder.stat().st_mtime
            except FileNotFoundError:  # its worker has removed it just now
                continue
            if age_seconds < 60:
                continue  # being made right now
            remove_folder(folder)
        else:
            with lock:
                remove_folder(folder)
        removed += 1
    for folder in (root / "datasets").glob("*"):
        with contextlib.suppress(OSError):  # in use, or gone already
            if time.time() - folder.stat().st_mtime < dataset_seconds:
                continue
            with (folder / LOCK_FILE).open("ab") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove_folder(folder)
            removed += 1
    return removed


def sweep_temporary(folder: Path, older_than_seconds: float) -> int:
    """Remove folders that killed checks of COLMAP models have left among the temporary files of this machine.

    Args:
        folder: of temporary files.
        older_than_seconds: what was changed since may be in use.

    Returns:
        Number of folders removed.
    """
    removed = 0
    for left in folder.glob("octasplat-model-????????"):
        with contextlib.suppress(OSError):
            facts = left.lstat()
            old = time.time() - facts.st_mtime > older_than_seconds
            if stat.S_ISDIR(facts.st_mode) and facts.st_uid == os.geteuid() and old:
                shutil.rmtree(left, ignore_errors=True)
                removed += 1
    return removed
