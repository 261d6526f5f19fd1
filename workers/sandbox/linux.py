"""Linux system calls that Python has no functions for."""

import ctypes
import errno
import os
import sys

PR_SET_PDEATHSIG = 1
PR_SET_DUMPABLE = 4
PR_SET_SECCOMP = 22
PR_CAPBSET_DROP = 24
PR_SET_CHILD_SUBREAPER = 36
PR_SET_NO_NEW_PRIVS = 38
IS_LINUX = sys.platform.startswith("linux")


def prctl(option: int, value: int = 0, pointer: object = 0) -> None:
    """Change a property of this process.

    Raises:
        OSError: the kernel refuses, or this is not Linux.
    """
    # As wide as a register: prctl is variadic, and an int may leave the upper half undefined.
    _call_libc(
        ctypes.c_int, "prctl", option, ctypes.c_ulong(value), pointer, ctypes.c_ulong(0), ctypes.c_ulong(0)
    )


def syscall(number: int, *arguments: object) -> int:
    """Call the kernel by number.

    Raises:
        OSError: the kernel refuses, or this is not Linux.
    """
    return _call_libc(ctypes.c_long, "syscall", ctypes.c_long(number), *arguments)


def _call_libc(kind: type[ctypes.c_int] | type[ctypes.c_long], name: str, *arguments: object) -> int:
    if not IS_LINUX:
        raise OSError(errno.ENOSYS, "this is not Linux")
    function = getattr(ctypes.CDLL(None, use_errno=True), name)
    function.restype = kind
    result = int(function(*arguments))
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result
