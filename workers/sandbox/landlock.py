"""Folders that a process cannot open any more (Landlock), and processes that it cannot signal.

https://docs.kernel.org/userspace-api/landlock.html. Landlock allows only what is named, so all folders beside
the path to a hidden one are named.
"""

import ctypes
import errno
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from octasplat.workers.sandbox.linux import PR_SET_NO_NEW_PRIVS, prctl, syscall

_CREATE, _ADD, _RESTRICT = 444, 445, 446
_PATH_BENEATH, _VERSION = 1, 1
_MIN_VERSION = 2
"""Before, files could not be linked from one folder to another."""
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_FOLDER = 1, 2, 4, 8
_REFER, _TRUNCATE, _DEVICE_IOCTL = 1 << 13, 1 << 14, 1 << 15
_SCOPES = 0b11
"""Neither signals to processes outside nor sockets without a name in the file system; from version 6."""
# The bits that each version knows: up to REFER, TRUNCATE from 3 on, IOCTL_DEV from 5 on.
_RIGHTS_BY_VERSION = ((2, (1 << 14) - 1), (3, (1 << 15) - 1), (5, (1 << 16) - 1))
_FILE_RIGHTS = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE | _DEVICE_IOCTL
_DEVICES = Path("/dev")
_WRITABLE_DEVICES = ("null", "nvidia*", "dri", "kfd")
_READABLE_DEVICES = ("zero", "full", "random", "urandom")
_READ_RIGHTS = _EXECUTE | _READ_FILE | _READ_FOLDER


class _Ruleset(ctypes.Structure):
    _fields_ = (("fs", ctypes.c_uint64), ("net", ctypes.c_uint64), ("scoped", ctypes.c_uint64))


class _PathBeneathRule(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def landlock_version() -> int:
    """Return which version of Landlock the kernel has; 0 for none that is of use."""
    try:
        version = syscall(_CREATE, ctypes.c_void_p(None), ctypes.c_size_t(0), ctypes.c_uint32(_VERSION))
    except OSError:
        return 0
    return version if version >= _MIN_VERSION else 0


def restrict_folders(
    hidden: Sequence[Path], *, writable: Sequence[Path] = (), readable: Sequence[Path] = ()
) -> None:
    """Let this process and all that it starts write to some folders only and read no hidden ones, for good.

    Args:
        hidden: what cannot be opened; devices cannot either, but for those of numbers and of graphics cards.
        writable: within the hidden ones, or elsewhere, folders that can be read and written.
        readable: within the hidden ones, folders that can be read.

    Raises:
        OSError: the kernel has no Landlock of use.
    """
    version = landlock_version()
    if not version:
        raise OSError(errno.ENOSYS, "the kernel has no Landlock of use")
    rights = max(mask for least, mask in _RIGHTS_BY_VERSION if version >= least)
    attributes = _Ruleset(rights, 0, _SCOPES if version >= 6 else 0)
    # 8 bytes are the first field alone, which is all that is asked of kernels before version 6.
    length = ctypes.sizeof(attributes) if version >= 6 else 8
    ruleset = syscall(_CREATE, ctypes.byref(attributes), ctypes.c_size_t(length), ctypes.c_uint32(0))
    try:
        shut = {Path(os.path.realpath(path)) for path in (*hidden, _DEVICES)}
        reading = _READ_RIGHTS & rights
        for path in _paths_without_hidden(Path("/"), shut):
            _add_rule(ruleset, path, reading)
        # Names can be listed everywhere, as whoever looks for modules does on the way to what is hidden.
        _add_rule(ruleset, Path("/"), _READ_FOLDER)
        for pattern, given in ((_WRITABLE_DEVICES, rights), (_READABLE_DEVICES, reading)):
            for path in (path for name in pattern for path in _DEVICES.glob(name)):
                _add_rule(ruleset, path, given)
        for paths, given in ((writable, rights), (readable, reading)):
            for path in paths:
                _add_rule(ruleset, Path(os.path.realpath(path)), given)
        # Else the kernel restricts only processes with CAP_SYS_ADMIN.
        prctl(PR_SET_NO_NEW_PRIVS, 1)
        syscall(_RESTRICT, ctypes.c_int(ruleset), ctypes.c_uint32(0))
    finally:
        os.close(ruleset)


def _paths_without_hidden(folder: Path, hidden: set[Path]) -> Iterator[Path]:
    """Yield the largest folders and files below ``folder`` that hold nothing hidden."""
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
            yield from _paths_without_hidden(Path(entry.path), hidden)


def _add_rule(ruleset: int, path: Path, rights: int) -> None:
    """Allow what there is at a path; nothing if it is gone, or cannot be opened anyway."""
    try:
        handle = os.open(path, os.O_PATH | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return
    try:
        allowed = rights if path.is_dir() else rights & _FILE_RIGHTS
        rule = _PathBeneathRule(allowed, handle)
        syscall(
            _ADD, ctypes.c_int(ruleset), ctypes.c_int(_PATH_BENEATH), ctypes.byref(rule), ctypes.c_uint32(0)
        )
    except OSError as error:
        if error.errno not in (errno.EBADFD, errno.EINVAL):  # nothing that rules are for, such as a pipe
            raise
    finally:
        os.close(handle)
