"""Filter of system calls (seccomp): no sockets, no access to other processes, no system changes.

https://docs.kernel.org/userspace-api/seccomp_filter.html. It holds for a process and all that it starts.
"""

import ctypes
import errno
import platform
from collections.abc import Iterator

from octasplat.workers.sandbox.linux import PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, prctl

_MODE_FILTER = 2
_ALLOW, _ERRNO, _KILL = 0x7FFF0000, 0x00050000, 0x80000000
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_NUMBER_OFFSET, _ARCH_OFFSET, _FIRST_ARGUMENT_OFFSET = 0, 4, 16
_CLONE_THREAD = 0x00010000
_X32_SYSCALL_BIT = 0x40000000
_ARCHES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
# Numbers on x86-64 and on 64-bit ARM; None where there is no such call.
_DENIED: dict[str, tuple[int | None, int | None]] = {
    "socket": (41, 198),
    "ptrace": (101, 117), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271),
    "pidfd_getfd": (438, 438), "kcmp": (312, 272),
    "bpf": (321, 280), "perf_event_open": (298, 241), "userfaultfd": (323, 282),
    "add_key": (248, 217), "request_key": (249, 218), "keyctl": (250, 219),
    "unshare": (272, 97), "setns": (308, 268), "mount": (165, 40), "umount2": (166, 39),
    "pivot_root": (155, 41), "chroot": (161, 51), "open_by_handle_at": (304, 265), "open_tree": (428, 428),
    "move_mount": (429, 429), "fsopen": (430, 430), "mount_setattr": (442, 442),
    "init_module": (175, 105), "finit_module": (313, 273), "delete_module": (176, 106),
    "kexec_load": (246, 104), "reboot": (169, 142), "swapon": (167, 224), "swapoff": (168, 225),
    "settimeofday": (164, 170), "clock_settime": (227, 112), "acct": (163, 89),
}  # fmt: skip
_PROCESS_CALLS: dict[str, tuple[int | None, int | None]] = {
    "fork": (57, None), "vfork": (58, None), "execve": (59, 221), "execveat": (322, 281),
}  # fmt: skip
# Programs fall back to older calls where they think that the kernel does not have these.
_ABSENT: dict[str, tuple[int | None, int | None]] = {"io_uring_setup": (425, 425)}
_CLONE, _CLONE3 = (56, 220), (435, 435)


class _Instruction(ctypes.Structure):
    _fields_ = (
        ("code", ctypes.c_uint16),
        ("yes", ctypes.c_uint8),
        ("no", ctypes.c_uint8),
        ("k", ctypes.c_uint32),
    )


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_uint16), ("filter", ctypes.POINTER(_Instruction)))


def has_seccomp() -> bool:
    """Return whether this kernel supports filters, and this processor type is known here."""
    if platform.machine() not in _ARCHES:
        return False
    try:
        prctl(PR_SET_SECCOMP, _MODE_FILTER, ctypes.c_void_p(None))
    except OSError as error:
        return error.errno == errno.EFAULT  # it would have read a filter
    return False


def install_seccomp_filter(*, may_start_processes: bool) -> None:
    """Block the system calls for good.

    Args:
        may_start_processes: whether it may start other programs, which have the same filter.

    Raises:
        OSError: the kernel does not take filters.
    """
    machine = platform.machine()
    if machine not in _ARCHES:
        raise OSError(errno.ENOSYS, f"the calls of {machine} are not known")
    instructions = list(_filter_instructions(machine, may_start_processes))
    array = (_Instruction * len(instructions))(*instructions)
    prctl(PR_SET_NO_NEW_PRIVS, 1)
    prctl(PR_SET_SECCOMP, _MODE_FILTER, ctypes.byref(_Program(len(instructions), array)))


def _filter_instructions(machine: str, may_start_processes: bool) -> Iterator[_Instruction]:
    column = list(_ARCHES).index(machine)
    yield _Instruction(_LOAD, 0, 0, _ARCH_OFFSET)
    yield _Instruction(_EQUAL, 1, 0, _ARCHES[machine])
    yield _Instruction(_RETURN, 0, 0, _KILL)  # calls of another processor would have other numbers
    yield _Instruction(_LOAD, 0, 0, _NUMBER_OFFSET)
    if machine == "x86_64":
        yield _Instruction(_AT_LEAST, 0, 1, _X32_SYSCALL_BIT)
        yield _Instruction(_RETURN, 0, 0, _ERRNO | errno.EPERM)
    denied = dict(_DENIED) if may_start_processes else {**_DENIED, **_PROCESS_CALLS}
    answers = {errno.EPERM: list(denied.values()), errno.ENOSYS: list(_ABSENT.values())}
    if not may_start_processes:
        answers[errno.ENOSYS].append(_CLONE3)  # its flags lie in memory, where a filter cannot read them
    for answer, numbers in answers.items():
        for number in filter(None, (pair[column] for pair in numbers)):
            yield _Instruction(_EQUAL, 0, 1, number)
            yield _Instruction(_RETURN, 0, 0, _ERRNO | answer)
    if not may_start_processes:
        yield _Instruction(_EQUAL, 0, 3, _CLONE[column])
        yield _Instruction(_LOAD, 0, 0, _FIRST_ARGUMENT_OFFSET)
        yield _Instruction(_ANY_BIT, 1, 0, _CLONE_THREAD)
        yield _Instruction(_RETURN, 0, 0, _ERRNO | errno.EPERM)
    yield _Instruction(_RETURN, 0, 0, _ALLOW)
