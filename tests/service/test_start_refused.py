"""A front end that cannot start says why in one sentence."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def start(**environment: str) -> "subprocess.CompletedProcess[str]":
    given = {name: value for name, value in os.environ.items() if not name.startswith("OCTASPLAT_")}
    return subprocess.run(
        [sys.executable, "-m", "octasplat", "api"],
        env={**given, "OCTASPLAT_PORT": "0", **environment},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.mark.exhaustive
def test_start_with_database_down_is_refused(tmp_path: Path) -> None:
    done = start(DATABASE_URL="postgresql://user:hush@127.0.0.1:9/x", OCTASPLAT_DATA=str(tmp_path))
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("Error: The database cannot be reached") and "DATABASE_URL" in line
    assert "hush" not in line


@pytest.mark.exhaustive
def test_serve_without_database_is_refused(tmp_path: Path) -> None:
    done = start(OCTASPLAT_DATA=str(tmp_path))
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) == 1 and done.stderr.startswith("Error: ")


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        pytest.param({}, "octasplat token create", marks=pytest.mark.exhaustive),
        ({"STORAGE": "/dev/null/store"}, "/dev/null/store"),
    ],
)
def test_start_with_invalid_settings_is_refused(
    conninfo: str, tmp_path: Path, settings: dict[str, str], word: str
) -> None:
    given = {f"OCTASPLAT_{name}": value for name, value in settings.items()}
    done = start(DATABASE_URL=conninfo, OCTASPLAT_DATA=str(tmp_path), **given)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("Error: ") and word in line
