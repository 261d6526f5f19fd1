"""A small disk that can be filled, which only root can make, and a limit on files that stands for one."""

import os
import resource
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def small_disk(folder: Path, size_mib: int) -> Iterator[Path]:
    """Mounts a disk of ``size_mib`` MiB at ``folder`` for as long as the block runs."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size_mib}m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("a small disk cannot be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextmanager
def files_no_larger_than(size_bytes: int) -> Iterator[None]:
    """Lets the system refuse to write on, as on a full disk, where a file has so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


def fill(folder: Path, leave_bytes: int) -> Path:
    """Takes room on the disk of ``folder`` until so much is left; returns the file that takes it."""
    ballast = folder / "ballast"
    facts = os.statvfs(folder)
    with ballast.open("wb") as handle:
        try:
            handle.write(bytes(max(0, facts.f_bavail * facts.f_frsize - leave_bytes)))
        except OSError:
            assert leave_bytes == 0
    return ballast
