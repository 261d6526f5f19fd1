"""Filter of system calls (seccomp): a list of what is allowed, the same for a process and all that it starts.

https://docs.kernel.org/userspace-api/seccomp_filter.html. The calls are those of
:mod:`octasplat.workers.sandbox.system_calls`. Some are allowed by their arguments only: limits, cores and
priority of the calling process itself, memory that is not shared without a file, files that are emptied as
they are opened for writing, clones in the namespaces and below the process that made them, and device calls
but those that type into a terminal.
"""

import ctypes
import errno
import platform
from collections.abc import Iterator, Sequence

from octasplat.workers.sandbox.linux import PR_SET_NO_NEW_PRIVS, PR_SET_SECCOMP, prctl
from octasplat.workers.sandbox.system_calls import (
    ALLOWED,
    CLONE,
    CLONE3,
    IOCTL,
    MMAP,
    OPEN,
    OPENAT,
    PROCESS_CALLS,
    REFUSED,
    SET_CORES,
    SET_LIMITS,
    SET_PRIORITY,
)

_MODE_FILTER = 2
# SECCOMP_RET_ALLOW, SECCOMP_RET_ERRNO and SECCOMP_RET_KILL_PROCESS.
_ALLOW, _ERRNO, _KILL = 0x7FFF0000, 0x00050000, 0x80000000
_REFUSE, _ABSENT = _ERRNO | errno.EPERM, _ERRNO | errno.ENOSYS
# BPF: LD|W|ABS, JMP|JEQ, JMP|JGE, JMP|JSET, ALU|AND and RET, all with a constant.
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _MASK, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x54, 0x06
# Places in struct seccomp_data, whose arguments begin at byte 16.
_NUMBER_OFFSET, _ARCH_OFFSET = 0, 4
_X32_SYSCALL_BIT = 0x40000000
# AUDIT_ARCH_X86_64 and AUDIT_ARCH_AARCH64.
_ARCHES = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
_CLONE_THREAD, _CLONE_PARENT, _CLONE_NEW = 0x00010000, 0x00008000, 0x7E020000
"""A clone that has another parent would not be counted; the last are all kinds of namespaces."""
_SHARED_WITHOUT_FILE = 0x21
"""MAP_SHARED and MAP_ANONYMOUS: such memory stays taken while no process has it mapped."""
_ACCESS_AND_TRUNCATION, _TRUNCATIONS_ALONE = 0x203, (0x200, 0x203)
"""Of the flags of open: so a file is emptied without being opened for writing, as far as Landlock before
version 3 knows."""
_TERMINAL_INPUT = (0x5412, 0x541C)
"""TIOCSTI and TIOCLINUX."""


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
    """Restrict the system calls to those of the list, for good.

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
        # Calls of x32 come as ones of x86-64, but with this bit in other numbers.
        yield _Instruction(_AT_LEAST, 0, 1, _X32_SYSCALL_BIT)
        yield _Instruction(_RETURN, 0, 0, _REFUSE)
    # Its flags lie in memory, where a filter cannot read them; libraries make threads without it then.
    yield from _answer_call(CLONE3[column], [_Instruction(_RETURN, 0, 0, _ABSENT)])
    for number, check in (
        (MMAP[column], [*_masked_argument(3, _SHARED_WITHOUT_FILE), *_refuse_if_equal(_SHARED_WITHOUT_FILE)]),
        (OPEN[column], _truncation_check(1)),
        (OPENAT[column], _truncation_check(2)),
        (CLONE[column], _clone_check(may_start_processes)),
        (
            IOCTL[column],
            [_argument(1), *(step for call in _TERMINAL_INPUT for step in _refuse_if_equal(call))],
        ),
        (SET_LIMITS[column], [_argument(0), *_refuse_unless_zero()]),
        (SET_CORES[column], [_argument(0), *_refuse_unless_zero()]),
        (SET_PRIORITY[column], [_argument(0), *_refuse_unless_zero(), _argument(1), *_refuse_unless_zero()]),
    ):
        if number is not None:
            yield from _answer_call(number, [*check, _Instruction(_RETURN, 0, 0, _ALLOW)])
    allowed = {**ALLOWED, **PROCESS_CALLS} if may_start_processes else ALLOWED
    refused = REFUSED if may_start_processes else {**REFUSED, **PROCESS_CALLS}
    for calls, answer in ((allowed, _ALLOW), (refused, _REFUSE)):
        for first, last in _ranges([pair[column] for pair in calls.values()]):
            # A number above the range skips both of the next instructions, one below it the second.
            yield _Instruction(_AT_LEAST, 2, 0, last + 1)
            yield _Instruction(_AT_LEAST, 0, 1, first)
            yield _Instruction(_RETURN, 0, 0, answer)
    yield _Instruction(_RETURN, 0, 0, _ABSENT)


def _clone_check(may_start_processes: bool) -> list[_Instruction]:
    flags = _argument(0)
    if may_start_processes:
        return [
            flags,
            _Instruction(_ANY_BIT, 0, 1, _CLONE_NEW | _CLONE_PARENT),
            _Instruction(_RETURN, 0, 0, _REFUSE),
        ]
    return [flags, _Instruction(_ANY_BIT, 1, 0, _CLONE_THREAD), _Instruction(_RETURN, 0, 0, _REFUSE)]


def _truncation_check(flags: int) -> list[_Instruction]:
    return [
        *_masked_argument(flags, _ACCESS_AND_TRUNCATION),
        *(step for alone in _TRUNCATIONS_ALONE for step in _refuse_if_equal(alone)),
    ]


def _answer_call(number: int, answer: Sequence[_Instruction]) -> Iterator[_Instruction]:
    """Yield instructions that answer one call; the number of any other stays loaded."""
    yield _Instruction(_EQUAL, 0, len(answer), number)
    yield from answer


def _argument(index: int) -> _Instruction:
    """Return the instruction that loads the lower half of an argument."""
    # Both processors are little-endian, so that the lower half comes first.
    return _Instruction(_LOAD, 0, 0, 16 + 8 * index)


def _masked_argument(index: int, mask: int) -> list[_Instruction]:
    return [_argument(index), _Instruction(_MASK, 0, 0, mask)]


def _refuse_if_equal(value: int) -> list[_Instruction]:
    return [_Instruction(_EQUAL, 0, 1, value), _Instruction(_RETURN, 0, 0, _REFUSE)]


def _refuse_unless_zero() -> list[_Instruction]:
    return [_Instruction(_EQUAL, 1, 0, 0), _Instruction(_RETURN, 0, 0, _REFUSE)]


def _ranges(numbers: Sequence[int | None]) -> list[tuple[int, int]]:
    """Return the ranges of consecutive numbers.

    >>> _ranges([3, None, 1, 2, 7])
    [(1, 3), (7, 7)]
    """
    found: list[tuple[int, int]] = []
    for number in sorted(number for number in numbers if number is not None):
        if found and found[-1][1] == number - 1:
            found[-1] = (found[-1][0], number)
        else:
            found.append((number, number))
    return found
