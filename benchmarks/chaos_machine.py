"""A running ``octasplat serve`` and everything that can be done to it."""

import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil

ROOT = Path(__file__).parents[1]
STALE_SECONDS = 3.0
FAST = {
    "HEARTBEAT_SECONDS": "0.5",
    "STALE_SECONDS": str(STALE_SECONDS),
    "RESCUE_SECONDS": "0.5",
    "POLL_SECONDS": "0.2",
    "GRACE_SECONDS": "10",
    "THREADS": "1",
    "FULL_DISK_SECONDS": "0.5",
    "KIND_MODULES": '["benchmarks.chaos_kind", "benchmarks.glutton_kind"]',
}
MIB = 1 << 20


def free_port() -> int:
    """A port of this machine that nobody uses right now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def small_disk(folder: Path, size_mib: int) -> Iterator[bool]:
    """A disk of that size at ``folder`` where one can be mounted, which takes root; tells whether it is."""
    folder.mkdir(parents=True, exist_ok=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={size_mib}m,mode=0711", "tmpfs", str(folder)]
    mounted = os.geteuid() == 0 and subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(folder)], check=False)


@dataclass
class Machine:
    """``octasplat serve`` on one data folder, with short limits on every wait.

    Args:
        data: the data folder.
        slots: jobs at once.
        small: whether the folder is on a small disk, which can be filled.
        settings: further ``OCTASPLAT_`` settings.
    """

    data: Path
    slots: int = 4
    small: bool = False
    settings: dict[str, str] = field(default_factory=dict)
    port: int = field(default_factory=free_port)
    process: "subprocess.Popen[bytes] | None" = None

    @property
    def address(self) -> str:
        """Where the front end answers."""
        return f"http://127.0.0.1:{self.port}"

    @property
    def token(self) -> str:
        """What it made for its own user."""
        return (self.data / "token").read_text().strip()

    @property
    def log(self) -> Path:
        """What everything said; not on the small disk."""
        return self.data.with_name(f"{self.data.name}.log")

    def start(self, seconds: float = 240) -> None:
        """Start everything and wait until requests are taken."""
        given = {**FAST, "FLOOR_BYTES": str(8 * MIB if self.small else 0), **self.settings}
        environment = {
            **os.environ,
            **{f"OCTASPLAT_{name}": value for name, value in given.items()},
            "PYTHONPATH": str(ROOT),
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "2",
        }
        environment.pop("DATABASE_URL", None)
        command = [sys.executable, "-m", "octasplat", "serve", "--data", str(self.data)]
        command += ["--port", str(self.port), "--queues", f"cpu={self.slots}"]
        (self.data / "serve.json").unlink(missing_ok=True)
        with self.log.open("ab") as output:
            self.process = subprocess.Popen(command, env=environment, cwd=ROOT, stdout=output, stderr=output)
        deadline = time.monotonic() + seconds
        # A blow at what is not found would be none, so that all of it must be there.
        while not ((self.data / "serve.json").exists() and self._is_whole()):
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"octasplat serve does not start:\n{self.log.read_text()[-4000:]}")
            time.sleep(0.05)

    def _is_whole(self) -> bool:
        return all(part() for part in (self.front_end, self.worker, self.database))

    def stop(self, seconds: float = 120) -> int:
        """Ask everything to end; returns the exit code."""
        assert self.process is not None
        if self.process.poll() is None:
            self.process.terminate()
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.power_cut()
            return -1

    def below(self, *words: str) -> list[psutil.Process]:
        """Living processes below ``octasplat serve`` whose command holds all words."""
        assert self.process is not None
        found = []
        with contextlib.suppress(psutil.Error):
            for process in psutil.Process(self.process.pid).children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    command = " ".join(process.cmdline())
                    if all(word in command for word in words):
                        found.append(process)
        return found

    def jobs(self) -> list[psutil.Process]:
        """The children of the worker."""
        return self.below("octasplat.workers.worker.child_main")

    def worker(self) -> list[psutil.Process]:
        """The worker that takes jobs."""
        return self.below("--queues cpu")

    def kept(self) -> list[psutil.Process]:
        """Everything that is started again when it ends: the front end and all workers."""
        return [*self.front_end(), *self.below("octasplat worker --queues")]

    def front_end(self) -> list[psutil.Process]:
        """The front end."""
        return self.below("octasplat.service.serving")

    def database(self) -> list[psutil.Process]:
        """The database's first process and those that it has started, in this order."""
        with contextlib.suppress(psutil.Error, OSError, ValueError):
            pid = int((self.data / "postgres/cluster/postmaster.pid").read_text().split()[0])
            first = psutil.Process(pid)
            return [first, *first.children()]
        return []

    def power_cut(self) -> None:
        """End everything at once, as the loss of the mains would (but for what the system has in memory)."""
        assert self.process is not None
        first = psutil.Process(self.process.pid) if self.process.poll() is None else None
        victims = [*([first] if first else []), *(first.children(recursive=True) if first else [])]
        victims += self.database()
        for victim in victims:
            _send(victim, signal.SIGKILL)
        self.process.wait()
        psutil.wait_procs(victims, timeout=10)


def _send(process: psutil.Process, number: signal.Signals) -> None:
    with contextlib.suppress(psutil.Error):
        process.send_signal(number)


def kill_child(machine: Machine, chance: random.Random) -> None:
    """kill -9 of one job's program."""
    victims = machine.jobs()
    if victims:
        _send(chance.choice(victims), signal.SIGKILL)


def kill_worker(machine: Machine, _chance: random.Random) -> None:
    """kill -9 of the worker."""
    for victim in machine.worker():
        _send(victim, signal.SIGKILL)


def kill_front_end(machine: Machine, _chance: random.Random) -> None:
    """kill -9 of the front end."""
    for victim in machine.front_end():
        _send(victim, signal.SIGKILL)


def kill_database(machine: Machine, _chance: random.Random) -> None:
    """kill -9 of Postgres."""
    for victim in machine.database()[:1]:
        _send(victim, signal.SIGKILL)


def kill_backend(machine: Machine, chance: random.Random) -> None:
    """kill -9 of one of Postgres' processes, after which it recovers by itself."""
    victims = machine.database()[1:]
    if victims:
        _send(chance.choice(victims), signal.SIGKILL)


def freeze_worker(machine: Machine, chance: random.Random) -> None:
    """SIGSTOP of the worker until its jobs are others', while their programs run on; then SIGCONT."""
    _freeze(machine.worker(), STALE_SECONDS + chance.uniform(0.5, 2.0))


def freeze_child(machine: Machine, chance: random.Random) -> None:
    """SIGSTOP and SIGCONT of one job's program."""
    victims = machine.jobs()
    if victims:
        _freeze([chance.choice(victims)], chance.uniform(0.5, 2.0))


def freeze_front_end(machine: Machine, chance: random.Random) -> None:
    """SIGSTOP and SIGCONT of the front end."""
    _freeze(machine.front_end(), chance.uniform(0.5, 2.0))


def freeze_database(machine: Machine, chance: random.Random) -> None:
    """SIGSTOP of all of Postgres for longer than workers wait for it; then SIGCONT."""
    _freeze(machine.database(), STALE_SECONDS + chance.uniform(0.0, 1.0))


def fill_disk(machine: Machine, chance: random.Random) -> None:
    """Every byte of the small disk is taken for a while: store, work and database have none."""
    if not machine.small:
        return
    ballast = machine.data / "ballast"
    try:
        with ballast.open("wb", buffering=0) as handle, contextlib.suppress(OSError):
            while True:
                handle.write(bytes(64 << 10))
        deadline = time.monotonic() + chance.uniform(2.0, 3.5)
        with ballast.open("ab", buffering=0) as handle:
            while time.monotonic() < deadline:  # what others free is taken as well
                with contextlib.suppress(OSError):
                    handle.write(bytes(4096))
                time.sleep(0.02)
    finally:
        ballast.unlink(missing_ok=True)


def restart_all(machine: Machine, _chance: random.Random) -> None:
    """Everything is stopped in good order and started again."""
    machine.stop()
    machine.start()


def cut_power(machine: Machine, _chance: random.Random) -> None:
    """Everything ends at once and is started again."""
    machine.power_cut()
    machine.start()


def _freeze(victims: list[psutil.Process], seconds: float) -> None:
    for victim in victims:
        _send(victim, signal.SIGSTOP)
    time.sleep(seconds)
    for victim in victims:
        _send(victim, signal.SIGCONT)


Blow = Callable[[Machine, random.Random], None]
BLOWS: tuple[Blow, ...] = (
    kill_child, freeze_worker, kill_front_end, kill_database, fill_disk, kill_worker, cut_power, freeze_child,
    kill_backend, freeze_database, freeze_front_end, restart_all,
)  # fmt: skip
