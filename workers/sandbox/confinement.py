"""Confinement of a child process before it reads untrusted data."""

import contextlib
import ctypes
import os
import resource
from collections.abc import Sequence
from pathlib import Path

import psutil

from octasplat.workers.sandbox.hiding import forbid_memory_access
from octasplat.workers.sandbox.landlock import restrict_folders
from octasplat.workers.sandbox.linux import (
    IS_LINUX,
    PR_CAPBSET_DROP,
    PR_SET_NO_NEW_PRIVS,
    prctl,
    syscall,
)
from octasplat.workers.sandbox.seccomp import install_seccomp_filter

MAX_PROCESSES = 256
"""Of one job; its programs start one or two others, such as ffmpeg."""
_MAX_THREADS = 4096
_EXTRA_MEMORY_BYTES = 4 << 30
"""The worker stops a program that needs more memory than it may; this ends what grows too fast for it."""
# The number of capset(2) by processor, and _LINUX_CAPABILITY_VERSION_3.
_CAPSET = {"x86_64": 126, "aarch64": 91}
_CAPABILITY_VERSION = 0x20080522


def confine(
    *,
    hidden: Sequence[Path] = (),
    writable: Sequence[Path] = (),
    readable: Sequence[Path] = (),
    may_start_processes: bool,
) -> None:
    """Give up rights for good; what the kernel does not support is left out.

    Args:
        hidden: folders that cannot be opened, see
            :func:`octasplat.workers.sandbox.landlock.restrict_folders`.
        writable: folders that can be written; nothing else can.
        readable: what can be read within the hidden folders.
        may_start_processes: whether other programs can be started, which have no more rights.
    """
    forbid_memory_access(is_measured=True)
    with contextlib.suppress(OSError):
        prctl(PR_SET_NO_NEW_PRIVS, 1)
    with contextlib.suppress(OSError):
        restrict_folders(hidden, writable=writable, readable=readable)
    with contextlib.suppress(OSError):
        _drop_capabilities()
    # Last, as the filter refuses calls that the steps above need.
    with contextlib.suppress(OSError):
        install_seccomp_filter(may_start_processes=may_start_processes)


def set_resource_limits(memory_limit_bytes: int | None) -> None:
    """Limit the processes and the memory of a job, which may grow faster than its worker checks."""
    with contextlib.suppress(ValueError, OSError, psutil.Error):
        _, most = resource.getrlimit(resource.RLIMIT_NPROC)
        limit = _count_user_threads() + _MAX_THREADS
        limit = limit if most == resource.RLIM_INFINITY else min(limit, most)
        resource.setrlimit(resource.RLIMIT_NPROC, (limit, limit))
    if memory_limit_bytes:
        with contextlib.suppress(ValueError, OSError):
            limit = memory_limit_bytes + _EXTRA_MEMORY_BYTES
            resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def _count_user_threads() -> int:
    """Return the number of threads of this user, which the process limit counts together."""
    uid, found = os.getuid(), 0
    for process in psutil.process_iter(("uids", "num_threads")):
        if process.info["uids"] is not None and process.info["uids"].real == uid:
            found += process.info["num_threads"] or 1
    return found


class _CapabilityHeader(ctypes.Structure):
    _fields_ = (("version", ctypes.c_uint32), ("pid", ctypes.c_int))


def _drop_capabilities() -> None:
    """Drop the capabilities of root: its own files stay accessible, other processes do not."""
    if not IS_LINUX or os.geteuid() != 0:
        return
    for number in range(64):
        try:
            prctl(PR_CAPBSET_DROP, number)
        except OSError:  # there are no more, or it may not
            break
    capset = _CAPSET.get(os.uname().machine)
    if capset is not None:
        header = _CapabilityHeader(_CAPABILITY_VERSION, 0)
        # Effective, permitted and inheritable sets, of two words each: all empty.
        syscall(capset, ctypes.byref(header), ctypes.byref((ctypes.c_uint32 * 6)()))
