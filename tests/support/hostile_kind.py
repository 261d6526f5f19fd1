"""A kind of job whose program does what code in a job's process could do that somebody has planted there."""

import ctypes
import mmap
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from octasplat.engine.core.events import Event, PhaseFinished, PhaseStarted
from octasplat.workers.worker.job_kinds import JobKind, register
from octasplat.workers.worker.task import Task
from tests.support.attempt_outcomes import write_outcomes

DAEMON = """
import os, sys, time
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        if sys.argv[1] == "quiet":
            os.closerange(0, 256)
        while True:
            time.sleep(0.001 if sys.argv[1] == "fleeing" else 1)
            if sys.argv[1] == "fleeing" and os.fork():
                os._exit(0)
"""
SYSCALLS = {"add_key": 248, "bpf": 321, "clone3": 435, "io_uring_setup": 425, "keyctl": 250, "mount": 165}
NEW_USER_NAMESPACE = 0x10000000


class HostileOptions(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    attack: str
    target: str = ""
    """A file or folder that is none of the job's."""
    pids: tuple[int, ...] = ()
    """Processes that are none of the job's."""
    size_bytes: int = 0
    lasts: bool = False
    """Goes on until it is stopped."""


class PreviewClaim(Event):
    """Says that there is a picture where there is a link."""

    kind = "preview_written"

    def as_dict(self) -> dict[str, object]:
        return {"kind": self.kind, "path": "token", "step": 1, "view": "a"}


class NonsenseEvent(Event):
    """A known event without what belongs to it."""

    kind = "stage_started"

    def as_dict(self) -> dict[str, object]:
        return {"kind": self.kind}


class DeepClaim(Event):
    """Says something in so many brackets as one can just write."""

    kind = "preview_written"

    def as_dict(self) -> dict[str, object]:
        path: list[object] = []
        for _ in range(900):
            path = [path]
        return {"kind": self.kind, "path": path, "step": 1, "view": "a"}


def run(task: Task) -> None:
    options = HostileOptions.model_validate(task.options)
    task.progress(PhaseStarted("train", 1))
    ATTACKS[options.attack](task, options)


def _link_run(task: Task, options: HostileOptions) -> None:
    """The engine's output folder is replaced by a link, and a picture is announced."""
    task.progress(NonsenseEvent())
    if task.run.exists():
        task.run.rename(task.folder / "aside")
    task.run.symlink_to(options.target)
    task.progress(PreviewClaim())
    _wait_for_gate(task, options)
    (task.results / "done.txt").write_text("done")


def _link_results(task: Task, options: HostileOptions) -> None:
    (task.folder / "results").symlink_to(options.target)


def _link_result(task: Task, options: HostileOptions) -> None:
    (task.results / "inner").symlink_to(options.target)


def _name_badly(task: Task, options: HostileOptions) -> None:
    """Write a file of a name that not every system takes, as a result or as poses that were found."""
    place = task.folder / options.target
    place.mkdir(parents=True)
    (place / "nul.txt").write_text("x")
    task.progress(PhaseFinished("poses", 0.0))  # after which poses are stored
    (task.results / "done.txt").write_text("done")


def _wait_for_gate(task: Task, options: HostileOptions) -> None:
    """Wait for the file ``gate`` beside the target."""
    while not Path(options.target).with_name("gate").exists() and not task.should_stop():
        time.sleep(0.05)


def _syscall(number: int, *arguments: object) -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    result = int(libc.syscall(ctypes.c_long(number), *arguments))
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result


def _clone_user_namespace() -> int:
    child = _syscall(56, ctypes.c_ulong(NEW_USER_NAMESPACE | signal.SIGCHLD), None, None, None, None)
    if child == 0:
        os._exit(0)
    return os.waitpid(child, 0)[1]


def _change_what_landlock_does_not_know(task: Task, options: HostileOptions) -> None:
    path, own = Path(options.target), task.folder / "own"
    own.write_text("x")
    handle = os.open(own, os.O_RDONLY)
    limits = (1, resource.RLIM_INFINITY)
    calls: dict[str, Callable[[], object]] = {
        "chmod": lambda: os.chmod(path, 0o644),  # noqa: PTH101
        "chmod by folder": lambda: os.chmod(path.name, 0o644, dir_fd=os.open(path.parent, os.O_PATH)),
        "fchmodat2": lambda: _syscall(452, -100, os.fsencode(path), 0o644, 0),
        "chown": lambda: os.chown(path, os.geteuid(), os.getegid()),
        "lchown": lambda: os.lchown(path, os.geteuid(), os.getegid()),
        "utime": lambda: os.utime(path, (1.0, 1.0)),
        "setxattr": lambda: os.setxattr(path, "user.planted", b"x"),
        "removexattr": lambda: os.removexattr(path, "user.planted"),
        "fsetxattr": lambda: os.setxattr(handle, "user.planted", b"x"),
        "truncate": lambda: os.truncate(own, 0),
        "truncate by reading": lambda: _syscall(257, -100, os.fsencode(own), os.O_RDONLY | os.O_TRUNC),
        "truncate by no access": lambda: _syscall(2, os.fsencode(own), 3 | os.O_TRUNC),
        "watch": lambda: _syscall(253),
        "namespace by clone": _clone_user_namespace,
        "namespace by unshare": lambda: _syscall(272, ctypes.c_ulong(NEW_USER_NAMESPACE)),
        "chroot": lambda: os.chroot("/"),
        "memory file": lambda: os.memfd_create("x"),
        "shared memory": lambda: mmap.mmap(-1, 1 << 20).close(),
        "system v": lambda: _syscall(29, 0, ctypes.c_size_t(4096), 0o1600),
        "message queue": lambda: _syscall(240, b"planted", 0o102, 0o600, None),
        "socket": lambda: socket.socket(socket.AF_UNIX).close(),
        "terminal": lambda: _syscall(16, 0, 0x5412, b"x"),
        **{
            name: (lambda number=number: _syscall(number, 0, 0, 0, 0, 0)) for name, number in SYSCALLS.items()
        },
    }
    for pid in options.pids:
        calls[f"limits of {pid}"] = lambda pid=pid: resource.prlimit(pid, resource.RLIMIT_CPU, limits)
        calls[f"cores of {pid}"] = lambda pid=pid: os.sched_setaffinity(pid, {0})
        calls[f"priority of {pid}"] = lambda pid=pid: os.setpriority(os.PRIO_PROCESS, pid, 19)
        calls[f"signal to {pid}"] = lambda pid=pid: os.kill(pid, signal.SIGTERM)
        calls[f"tracing of {pid}"] = lambda pid=pid: _syscall(101, 16, pid, 0, 0)
    write_outcomes(task, calls)


def _tell_user(task: Task, options: HostileOptions) -> None:
    """Who it is, and what it can do as that user."""
    worker = Path(f"/proc/{os.getppid()}/environ")
    write_outcomes(
        task,
        {
            "user": lambda: [*os.getresuid(), *os.getresgid(), *os.getgroups()],
            "return": lambda: os.setresuid(0, 0, 0),
            "environment of the guard": worker.read_bytes,
            "target": lambda: Path(options.target).read_text(),
            "folder": lambda: (task.folder / "own").write_text("x"),
        },
    )


def _leave_daemon(task: Task, options: HostileOptions) -> None:
    """Leave a process of another session without a parent; ``target`` says what it does."""
    # With the pipes of the job, and with the name of the attempt, by which it is found.
    how = options.target or "quiet"
    subprocess.run([sys.executable, "-c", DAEMON, how, f"daemon of {task.folder.name}"], check=True)
    task.progress(PhaseStarted("evaluate", 1))
    while options.lasts and not task.should_stop():
        time.sleep(0.05)
    write_outcomes(task, {})


def _hog_shared_memory(task: Task, options: HostileOptions) -> None:
    def hog() -> int:
        shared = mmap.mmap(-1, options.size_bytes)
        for start in range(0, options.size_bytes, 4096):
            shared[start] = 1
        time.sleep(5)
        return len(shared)

    write_outcomes(task, {"hog": hog})


def _write_elsewhere(task: Task, options: HostileOptions) -> None:
    import numpy

    import octasplat

    folders = {
        "engine": Path(octasplat.__file__).resolve().parent / "engine",
        "site-packages": Path(numpy.__file__).parents[1],
        "home": Path.home(),
        "etc": Path("/etc"),
        "shared memory": Path("/dev/shm"),
        "temporary": Path("/tmp"),
        "lasting temporary": Path("/var/tmp"),
        "target": Path(options.target),
    }

    def write(folder: Path) -> str:
        path = folder / f"planted-{os.path.basename(task.folder)}"  # noqa: PTH119
        path.write_text("x")
        path.unlink()
        return str(path)

    devices = list(Path("/dev").glob("[vs]d[a-z]"))
    write_outcomes(
        task,
        {
            **{name: (lambda folder=folder: write(folder)) for name, folder in folders.items()},
            **{str(path): (lambda path=path: path.open("rb").close()) for path in devices},
            "own folder": lambda: write(task.folder) and "written",
            "own temporary": lambda: write(Path(os.environ["TMPDIR"])) and "written",
        },
    )


def _dig(task: Task, options: HostileOptions) -> None:
    """Make folders in each other, deeper than a stack is, and tell something as deep."""
    task.progress(DeepClaim())
    folder = os.open(task.folder, os.O_RDONLY)
    for _ in range(1500):
        os.mkdir("d", dir_fd=folder)
        outer, folder = folder, os.open("d", os.O_RDONLY, dir_fd=folder)
        os.close(outer)
    while options.lasts and not task.should_stop():
        time.sleep(0.05)
    write_outcomes(task, {})


ATTACKS: Mapping[str, Callable[[Task, HostileOptions], None]] = {
    "link run": _link_run,
    "link results": _link_results,
    "link result": _link_result,
    "bad name": _name_badly,
    "calls": _change_what_landlock_does_not_know,
    "daemon": _leave_daemon,
    "shared memory": _hog_shared_memory,
    "user": _tell_user,
    "write elsewhere": _write_elsewhere,
    "dig": _dig,
}

register(
    JobKind(
        name="hostile",
        title="Does harm",
        needs="dataset",
        options=HostileOptions,
        program="tests.support.hostile_kind:run",
        stages=("train",),
    )
)
