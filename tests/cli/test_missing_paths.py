"""Paths that do not exist and services that do not run are told before anything heavy is imported."""

import socket
import subprocess
import sys

import pytest

HEAVY = ("torch", "numba", "pycolmap", "scipy", "PIL")
CODE = """
import sys
from octasplat.__main__ import cli
try:
    cli({arguments!r})
except SystemExit as end:
    assert end.code == 1, end.code
heavy = set({heavy!r}) & set(sys.modules)
assert not heavy, heavy
"""


@pytest.mark.parametrize(
    ("arguments", "missing"),
    [
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
    ],
)
def test_missing_path_is_refused_before_heavy_imports(arguments: list[str], missing: str) -> None:
    code = CODE.format(arguments=arguments, heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == f"Error: {missing}: cannot be read (No such file or directory).\n"


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
