"""Signals belong to the program that uses octasplat, whatever the libraries do that it loads."""

import subprocess
import sys
from pathlib import Path

import pytest

CODE = """
import faulthandler, os, signal, sys, threading
asked = []
signal.signal(signal.SIGTERM, lambda *_: asked.append("SIGTERM"))
faulthandler.enable()
import octasplat as osp
from octasplat.engine.core.colmap_binding import pycolmap
def estimate():
    osp.estimate("photos", preset="fast", max_side=48)
    assert pycolmap.Camera  # loaded now, if it was not before
thread = threading.Thread(target=estimate)
if sys.argv[1] == "thread":
    thread.start()
    thread.join()
else:
    estimate()
assert "pycolmap" in sys.modules
os.kill(os.getpid(), signal.SIGTERM)
print(asked)
if sys.argv[2] == "crash":
    os.kill(os.getpid(), signal.SIGSEGV)
"""


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the program in a folder."""
    command = [sys.executable, "-c", CODE, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("where", ["main", "thread"])
def test_a_programs_own_handler_of_sigterm_is_called(photographs: Path, where: str) -> None:
    done = run(photographs.parent, where, "end")
    assert (done.returncode, done.stdout) == (0, "['SIGTERM']\n"), done.stderr
    assert "Aborted" not in done.stderr


def test_a_crash_is_told_by_the_programs_own_fault_handler(photographs: Path) -> None:
    done = run(photographs.parent, "main", "crash")
    assert "Fatal Python error: Segmentation fault" in done.stderr
    assert "*** Aborted" not in done.stderr
