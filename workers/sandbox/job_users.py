"""Users that jobs run as: each as one of its own, where root runs the worker and names some."""

import contextlib
import fcntl
import os
import re
import stat
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import IO

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.isolated_python import ROOT
from octasplat.engine.core.kernel_folder import CACHE_VARIABLE, shared_cache_folder

_RANGE = re.compile(r"(\d+)-(\d+)")
_FIRST_UID = 1000
"""Below are users of the system."""


def parse_uids(text: str) -> range:
    """Return the user ids of a range such as ``200000-200063``.

    Raises:
        ValueError: it is none, or has users of the system.
    """
    found = _RANGE.fullmatch(text.strip())
    if found is None or not _FIRST_UID <= int(found[1]) <= int(found[2]) < 2**31:
        raise ValueError(f"{text!r} is not a range of user ids from {_FIRST_UID} on, such as 200000-200063")
    return range(int(found[1]), int(found[2]) + 1)


class JobUser:
    """A user that no other job of this machine runs as, until it is given back.

    Attributes:
        uid: of the user and of its group.
    """

    def __init__(self, uid: int, lock: IO[bytes]) -> None:
        self.uid = uid
        self._lock = lock

    def close(self) -> None:
        """Give the user back; nothing may run as it any more."""
        self._lock.close()


def take_user(uids: Iterable[int], work: Path) -> JobUser:
    """Return a user that is free.

    Args:
        uids: to choose from.
        work: folder of all work on this machine, by which its workers agree.

    Raises:
        ConfigError: all are taken.
    """
    folder = work / "users"
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for uid in uids:
        lock = (folder / str(uid)).open("ab")
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return JobUser(uid, lock)
        lock.close()
    raise ConfigError("Fewer users are named by OCTASPLAT_JOB_UIDS than jobs run at once; name more of them.")


def check_job_users(uids: range, jobs: int, work: Path) -> None:
    """Check that other users can get at what jobs need, and open the work folder for passing through.

    Args:
        uids: users to choose from.
        jobs: that may run at once.
        work: folder of all work on this machine.

    Raises:
        ConfigError: this is not root, a folder is shut, or the users are too few.
    """
    if len(uids) < jobs:
        raise ConfigError(f"OCTASPLAT_JOB_UIDS names {len(uids)} users for {jobs} jobs at once; name more.")
    if os.geteuid() != 0:
        raise ConfigError("OCTASPLAT_JOB_UIDS needs a worker that root runs; run it so, or name no users.")
    for folder in (work, work / "attempts", work / "datasets"):
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o711)
    needed = {
        work: "name another folder by OCTASPLAT_WORK",
        Path(sys.executable).resolve(): "install Python where others can read it",
        ROOT.resolve(): "install octasplat where others can read it",
        shared_cache_folder(): f"name another folder by {CACHE_VARIABLE}",
    }
    for path, remedy in needed.items():
        for folder in (path, *path.parents):
            if folder.is_dir() and not folder.stat().st_mode & stat.S_IXOTH:
                raise ConfigError(f"{folder} is shut to the users of OCTASPLAT_JOB_UIDS; {remedy}.")


def give_folder(folder: Path, uid: int) -> None:
    """Make a folder, and what is in it but files shared with others, that of a user."""
    os.chown(folder, uid, uid)
    for _, folders, files, fd in os.fwalk(folder, follow_symlinks=False):
        for name in (*folders, *files):
            facts = os.stat(name, dir_fd=fd, follow_symlinks=False)
            if stat.S_ISDIR(facts.st_mode) or facts.st_nlink == 1:
                os.chown(name, uid, uid, dir_fd=fd, follow_symlinks=False)


def open_for_reading(folder: Path) -> None:
    """Let other users read a folder that is not listed to them."""
    folder.chmod(0o755)
    for _, folders, files, fd in os.fwalk(folder, follow_symlinks=False):
        for name in (*folders, *files):
            with contextlib.suppress(FileNotFoundError):  # another attempt has fetched and renamed it
                facts = os.stat(name, dir_fd=fd, follow_symlinks=False)
                if stat.S_ISDIR(facts.st_mode):
                    os.chmod(name, 0o755, dir_fd=fd)  # noqa: S103 - their parents are not listed
                elif facts.st_nlink == 1:  # another has access of the store's own
                    os.chmod(name, 0o444, dir_fd=fd)


def become_user(uid: int, home: Path) -> None:
    """Go on as another user, for good; the kernels of this one can still be read.

    Raises:
        OSError: the system does not let it.
    """
    os.environ[CACHE_VARIABLE] = str(shared_cache_folder())
    os.environ.update(HOME=str(home), USER=str(uid), LOGNAME=str(uid))
    os.environ.pop("XDG_CACHE_HOME", None)
    # The user id last: only root may change the groups.
    os.setgroups([])
    os.setresgid(uid, uid, uid)
    os.setresuid(uid, uid, uid)
