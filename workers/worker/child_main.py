"""Guard of a job's process: starts it, and ends whatever it leaves behind.

    python -m octasplat.workers.worker.child_main WORKER_PID

Run by :func:`octasplat.engine.core.isolated_python.python_command`. The guard forks; its child runs
:mod:`octasplat.workers.worker.job_process` with the pipes to the worker, of which the guard keeps none;
it reads nothing that a job writes. On Linux it is a subreaper: processes that lose their parents become its
children, whatever session they are in. When the program has ended, when the worker dies, or at
:data:`END_SIGNAL`, it kills all of them until there are none, and ends as the program has ended.
"""

import contextlib
import os
import signal
import sys
import time
from pathlib import Path
from typing import NoReturn

from octasplat.workers.parent_death_signal import set_parent_death_signal
from octasplat.workers.sandbox.hiding import forbid_memory_access
from octasplat.workers.sandbox.linux import PR_SET_CHILD_SUBREAPER, prctl
from octasplat.workers.sandbox.process_tree import kill_descendants

END_SIGNAL = signal.SIGUSR1
"""Not SIGTERM, which systemd sends to all processes of a service that is to stop by itself."""
NICENESS = 10
"""By which a job yields to its worker, and to a front end and a database on the same host."""
_HANDLED = {signal.SIGCHLD, signal.SIGTERM, signal.SIGINT, END_SIGNAL}
_EAGER_ROUNDS = 2_000
"""At first without pauses, as some may start others as fast as they are killed."""
_PAUSE_SECONDS = 0.01


def main() -> NoReturn:
    """Run the job's process and end as it ends."""
    _lower_priority()
    # Blocked before the fork, so that sigwait loses none that arrives early.
    signal.pthread_sigmask(signal.SIG_BLOCK, _HANDLED)
    # Elsewhere than on Linux the program sees the end of its stdin.
    set_parent_death_signal(int(sys.argv[1]), END_SIGNAL)
    with contextlib.suppress(OSError):
        prctl(PR_SET_CHILD_SUBREAPER, 1)
    guard = os.getpid()
    program = os.fork()
    if program == 0:
        # A group of its own for killpg, where the system has no subreapers.
        os.setpgid(0, 0)
        # The mask is inherited, and the program has to receive SIGTERM.
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _HANDLED)
        set_parent_death_signal(guard, signal.SIGKILL)
        from octasplat.workers.worker.job_process import run_job

        run_job()
    forbid_memory_access(is_measured=True)
    # Copies of the pipes here would hide their end from the worker when the program ends.
    nothing = os.open(os.devnull, os.O_RDWR)
    for pipe in (0, 1, 2):
        os.dup2(nothing, pipe)
    status = _wait_for_program(program)
    status = _end_all(program, status)
    # By the same signal as the program, as the worker reads the cause from it.
    if os.WIFSIGNALED(status):
        _end_by_signal(os.WTERMSIG(status))
    os._exit(os.waitstatus_to_exitcode(status))


def _lower_priority() -> None:
    """Lower the CPU priority of this session."""
    os.nice(NICENESS)
    # Between sessions Linux compares the niceness of these groups alone, where it makes them.
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(os.nice(0)), encoding="ascii")


def _wait_for_program(program: int) -> int | None:
    """Wait for the end of the program; return its status, or None where it has to be ended."""
    while True:
        number = signal.sigwait(_HANDLED)
        if number == END_SIGNAL:
            return None
        if number == signal.SIGTERM:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(program, number)
        # SIGCHLD says only that some child ended: adopted ones arrive here too, and several make one signal.
        _, status = _reap(program)
        if status is not None:
            return status


def _end_all(program: int, status: int | None) -> int:
    """Kill all descendants until there are none; return the status of the program."""
    rounds = 0
    while True:
        if rounds == 0:  # for systems without subreapers
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(program, signal.SIGKILL)
        kill_descendants(os.getpid())
        is_alone, found = _reap(program)
        status = found if status is None else status
        if is_alone:
            return signal.SIGKILL if status is None else status
        rounds += 1
        if rounds > _EAGER_ROUNDS:
            time.sleep(_PAUSE_SECONDS)


def _reap(program: int) -> tuple[bool, int | None]:
    """Take note of ended children; return whether none is left, and the status of the program if it ended."""
    found = None
    try:
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG)
            if pid == 0:
                return False, found
            if pid == program:
                found = status
    except ChildProcessError:
        return True, found


def _end_by_signal(number: int) -> NoReturn:
    with contextlib.suppress(OSError, ValueError):  # SIGKILL has no handler
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})
    os.kill(os.getpid(), number)
    # Where the signal did not end this process; 128 + number is the convention of shells.
    os._exit(128 + number)


if __name__ == "__main__":
    main()
