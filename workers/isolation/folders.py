"""Folders that a process cannot open any more (Landlock), and processes that it cannot signal.

https://docs.kernel.org/userspace-api/landlock.html. Landlock allows what is named and nothing else, so that
all is named that lies beside the way to what is hidden.
"""

import ctypes
import errno
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from octasplat.workers.isolation.kernel import PR_SET_NO_NEW_PRIVS, prctl, syscall

_CREATE, _ADD, _RESTRICT = 444, 445, 446
_PATH_BENEATH, _VERSION = 1, 1
_LEAST_VERSION = 2
"""Before, files could not be linked from one folder to another."""
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_FOLDER = 1, 2, 4, 8
_REFER, _TRUNCATE, _DEVICES = 1 << 13, 1 << 14, 1 << 15
_SCOPED = 0b11
"""Neither signals to processes outside nor sockets without a name in the file system; from version 6."""
_RIGHTS_BY_VERSION = ((2, (1 << 14) - 1), (3, (1 << 15) - 1), (5, (1 << 16) - 1))
_OF_FILES = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE | _DEVICES
_READING = _EXECUTE | _READ_FILE | _READ_FOLDER


class _Ruleset(ctypes.Structure):
    _fields_ = (("fs", ctypes.c_uint64), ("net", ctypes.c_uint64), ("scoped", ctypes.c_uint64))


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def landlock_version() -> int:
    """Which version of Landlock the kernel has; 0 for none that is of use."""
    try:
        version = syscall(_CREATE, ctypes.c_void_p(None), ctypes.c_size_t(0), ctypes.c_uint32(_VERSION))
    except OSError:
        return 0
    return version if version >= _LEAST_VERSION else 0


def hide_folders(
    hidden: Sequence[Path],
    *,
    written: Sequence[Path] = (),
    read: Sequence[Path] = (),
    elsewhere_reads_only: bool,
) -> None:
    """Make folders inaccessible to this process and all that it starts, for good.

    Args:
        hidden: what cannot be opened.
        written: within the hidden ones, or elsewhere, folders that can be read and written.
        read: within the hidden ones, folders that can be read.
        elsewhere_reads_only: whether all other folders can be read only.

    Raises:
        OSError: the kernel has no Landlock of use.
    """
    version = landlock_version()
    if not version:
        raise OSError(errno.ENOSYS, "the kernel has no Landlock of use")
    rights = max(mask for least, mask in _RIGHTS_BY_VERSION if version >= least)
    attributes = _Ruleset(rights, 0, _SCOPED if version >= 6 else 0)
    length = ctypes.sizeof(attributes) if version >= 6 else 8
    ruleset = syscall(_CREATE, ctypes.byref(attributes), ctypes.c_size_t(length), ctypes.c_uint32(0))
    try:
        shut = {Path(os.path.realpath(path)) for path in hidden}
        reading = _READING & rights
        for path in _beside(Path("/"), shut):
            _allow(ruleset, path, reading if elsewhere_reads_only else rights)
        # Names can be listed everywhere, as whoever looks for modules does on the way to what is hidden.
        _allow(ruleset, Path("/"), _READ_FOLDER)
        for path in (Path("/dev/null"), Path("/dev/zero"), Path("/dev/shm")):  # noqa: S108 - a device
            _allow(ruleset, path, rights)
        for paths, given in ((written, rights), (read, reading)):
            for path in paths:
                _allow(ruleset, Path(os.path.realpath(path)), given)
        prctl(PR_SET_NO_NEW_PRIVS, 1)
        syscall(_RESTRICT, ctypes.c_int(ruleset), ctypes.c_uint32(0))
    finally:
        os.close(ruleset)


def _beside(folder: Path, hidden: set[Path]) -> Iterator[Path]:
    """The largest folders and files below ``folder`` that hold nothing hidden."""
    if folder in hidden:
        return
    if not any(path.is_relative_to(folder) for path in hidden):
        yield folder
        return
    try:
        entries = list(os.scandir(folder))
    except OSError:
        return
    for entry in entries:
        if not entry.is_symlink():  # where it leads to is met by itself
            yield from _beside(Path(entry.path), hidden)


def _allow(ruleset: int, path: Path, rights: int) -> None:
    """Allow what there is at a path; nothing if it is gone, or cannot be opened anyway."""
    try:
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return
    try:
        allowed = rights if path.is_dir() else rights & _OF_FILES
        rule = _Beneath(allowed, handle)
        syscall(
            _ADD, ctypes.c_int(ruleset), ctypes.c_int(_PATH_BENEATH), ctypes.byref(rule), ctypes.c_uint32(0)
        )
    except OSError as error:
        if error.errno not in (errno.EBADFD, errno.EINVAL):  # nothing that rules are for, such as a pipe
            raise
    finally:
        os.close(handle)
