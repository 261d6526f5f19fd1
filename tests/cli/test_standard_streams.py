"""Standard streams that are closed or full, as shells and services give them to commands."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.daily import some_daily


def octasplat_in_shell(redirection: str, *arguments: object) -> "subprocess.CompletedProcess[str]":
    """Run the command line with a redirection of the shell."""
    line = f'"$@" {redirection}'
    command = [sys.executable, "-m", "octasplat", *map(str, arguments)]
    return subprocess.run(
        ["sh", "-c", line, "sh", *command], capture_output=True, text=True, check=False, timeout=120
    )


@pytest.mark.parametrize("redirection", some_daily([">&-", ">&- <&-"], [">&- <&-"]))
def test_command_does_its_work_with_standard_output_closed(run, tmp_path: Path, redirection: str) -> None:
    done = octasplat_in_shell(redirection, "clean", run.output / "scene.ply", "-o", tmp_path / "clean.ply")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "clean.ply").read_bytes().startswith(b"ply")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no such device")  # noqa: PTH110
@pytest.mark.parametrize("options", [(), pytest.param(("--json",), marks=pytest.mark.exhaustive)])
def test_full_disk_behind_standard_output_is_told(run, options: tuple[str, ...]) -> None:
    done = octasplat_in_shell(">/dev/full", "info", run.output, *options)
    assert done.returncode == 1
    assert done.stderr == "Error: Standard output cannot be written (No space left on device).\n"


def test_reader_that_leaves_early_is_no_error(run) -> None:
    done = octasplat_in_shell("| true", "info", run.output)
    assert (done.returncode, done.stderr) == (0, "")
