"""Limits of jobs hold where ``/proc`` is mounted with hidepid, as systemd's ProtectProc does."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from octasplat.workers.sandbox.hiding import _hides_processes

PROGRAM = """
import ctypes, os, signal, subprocess, sys, time
from octasplat.workers.sandbox.hiding import forbid_memory_access
from octasplat.workers.sandbox.linux import PR_SET_DUMPABLE, prctl
from octasplat.workers.sandbox.process_tree import tree_memory_bytes

libc = ctypes.CDLL(None, use_errno=True)
if libc.unshare(0x20000) or subprocess.run(["mount", "--make-rprivate", "/"]).returncode:
    sys.exit(77)
if subprocess.run(["mount", "-t", "proc", "-o", "hidepid=2", "proc", "/proc"]).returncode:
    sys.exit(77)
os.setgroups([])
os.setresgid(65534, 65534, 65534)
os.setresuid(65534, 65534, 65534)
prctl(PR_SET_DUMPABLE, 1)
told, tell = os.pipe()
child = os.fork()
if child == 0:
    if sys.argv[1] == "hidden":
        prctl(PR_SET_DUMPABLE, 0)
    else:
        forbid_memory_access(is_measured=True)
    memory = bytearray(64 << 20)
    memory[::4096] = b"x" * len(memory[::4096])
    os.write(tell, b"x")
    time.sleep(60)
    os._exit(0)
os.read(told, 1)
try:
    print(tree_memory_bytes(child) >> 20)
except PermissionError as error:
    print(error)
finally:
    os.kill(child, signal.SIGKILL)
"""


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root mounts /proc")
@pytest.mark.parametrize(("how", "expected"), [("measured", ""), ("hidden", "/proc hides the process")])
def test_memory_of_jobs_is_measured_where_proc_hides_processes(how: str, expected: str) -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, timeout=120)
    if done.returncode == 77:
        pytest.skip("/proc cannot be mounted here")
    assert done.returncode == 0, done.stderr
    assert expected in done.stdout if expected else 64 <= int(done.stdout) < 200


@pytest.mark.parametrize(
    ("options", "hides"),
    [("rw", False), ("rw,hidepid=0", False), ("rw,hidepid=off", False), ("rw,hidepid=2", True)],
)
def test_options_of_the_mount_tell_whether_processes_are_hidden(
    tmp_path: Path, options: str, hides: bool
) -> None:
    mounts = tmp_path / "mountinfo"
    other = "23 1 0:21 / /sys rw - sysfs sysfs rw,hidepid=2\n"
    mounts.write_text(f"{other}24 1 0:22 / /proc rw,nosuid - proc proc {options}\n")
    assert _hides_processes(mounts) == hides
