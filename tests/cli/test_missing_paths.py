"""Paths that do not exist and services that do not run are told before anything heavy is imported."""

import socket
import subprocess
import sys

import pytest

HEAVY = ("torch", "numba", "pycolmap", "scipy", "PIL")
MISSING = [
    (["view", "none"], "none"),
    (["info", "none.ply"], "none.ply"),
    (["render", "none", "-o", "turn.mp4"], "none"),
    (["render", "tests", "--path", "none.json", "-o", "turn.mp4"], "none.json"),
    (["export", "none", "scene.spz"], "none"),
    (["evaluate", "none"], "none"),
    (["evaluate", "tests", "--other-dataset", "none"], "none"),
    (["reconstruct", "none", "-o", "out"], "none"),
    (["estimate", "none"], "none"),
    (["surface", "none", "-o", "mesh.glb"], "none"),
    (["edit", "none.ply", "--mesh", "none.obj", "-o", "out.ply"], "none.ply"),
    (["edit", "pyproject.toml", "--mesh", "none.obj", "-o", "out.ply"], "none.obj"),
    (["merge", "none.ply", "none2.ply", "-o", "out.ply"], "none.ply"),
]
"""Commands, and what is not there."""
CODE = f"""
import sys
from octasplat.__main__ import cli
for arguments in {[arguments for arguments, _ in MISSING]!r}:
    try:
        cli(arguments)
    except SystemExit as end:
        assert end.code == 1, (arguments, end.code)
    heavy = set({HEAVY!r}) & set(sys.modules)
    assert not heavy, (arguments, heavy)
"""


def test_missing_path_is_refused_before_heavy_imports() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines() == [
        f"Error: {missing}: cannot be read (No such file or directory)." for _, missing in MISSING
    ]


@pytest.mark.parametrize(
    "command",
    [
        ["jobs"],
        ["status", "last"],
        ["logs", "last"],
        ["cancel", "last"],
        ["retry", "last"],
        ["open", "--print"],
    ],
)
def test_commands_without_service_do_not_wait(command, octasplat, monkeypatch) -> None:
    pauses: list[float] = []
    monkeypatch.setattr("time.sleep", pauses.append)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{probe.getsockname()[1]}"  # nobody listens
        result = octasplat(*command, "--server", address)
    assert result.exit_code == 1 and pauses == []
    assert f"No service answers at {address}" in result.output and "octasplat serve" in result.output
