"""Tables, JSON, short ids, groups of commands, completion and versions of the command line."""

import json
import math
import os
import subprocess
import sys
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from octasplat.__main__ import cli
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.evaluate.summary import summarize_run
from octasplat.engine.operations.base import Result
from octasplat.workers.cli.main import main
from octasplat.workers.cli.printing import Printer, json_text, local_time, output_options, table_lines
from octasplat.workers.cli.versions import cpu_features
from octasplat.workers.client.short_ids import find_job, list_rows, short_id

IDS = [f"01999999-0000-7000-8000-0000000{k:05x}" for k in (0x12345, 0xA2345, 0xFEDCB)]


class FakeApi:
    """A service that knows some jobs, two to a page."""

    def __init__(self) -> None:
        self.asked: list[tuple[str, dict[str, Any]]] = []

    def get(self, path: str, **query: Any) -> Any:
        self.asked.append((path, query))
        if path != "/v1/jobs":
            return {"id": path.rpartition("/")[2]}
        start = int(query.get("cursor", 0))
        end = start + min(query["limit"], 2)
        return {"jobs": [{"id": one} for one in IDS[start:end]], "next": str(end) if end < len(IDS) else None}


def test_table_has_headers_and_no_empty_columns() -> None:
    rows = [("a1", "", 7, "1.5 dB"), ("b22", "", 1234, "")]
    assert table_lines(("Id", "Note", "Count", "PSNR"), rows) == [
        "Id   Count    PSNR",
        "a1       7  1.5 dB",
        "b22   1234",
    ]
    assert table_lines(("Id",), []) == []


def test_json_of_results_and_of_numbers_that_are_not_finite() -> None:
    class Found(Result):
        values: dict[str, float]

    @dataclass
    class Row:
        path: Path
        at: datetime

    found = Found(files=(Path("a.ply"),), folder=Path("out"), values={"psnr": math.inf})
    assert json.loads(json_text(found.facts())) == {"files": ["a.ply"], "values": {"psnr": None}}
    row = Row(Path("b"), datetime(2026, 1, 2, tzinfo=UTC))
    assert json.loads(json_text([row])) == [{"path": "b", "at": "2026-01-02T00:00:00Z"}]
    assert json.loads(json_text({"image": np.ones((1, 2), np.int64)})) == {"image": [[1, 1]]}


@pytest.mark.parametrize(
    ("flags", "printed"),
    [
        ([], "note\ntwo rows\n"),
        (["-q"], "1\n2\n"),
        (["--json"], "[\n  1,\n  2\n]\n"),
        (["--json", "-q"], "[\n  1,\n  2\n]\n"),
    ],
)
def test_one_mechanism_prints_text_ids_or_json(flags: list[str], printed: str) -> None:
    from click.testing import CliRunner

    @click.command()
    @output_options
    def command(printer: Printer) -> None:
        printer.note("note")
        printer.print([1, 2], ["two rows"], quiet_lines=["1", "2"])

    assert CliRunner().invoke(command, flags).stdout == printed


def test_every_command_that_prints_a_result_has_json_and_quiet() -> None:
    without = set()
    context = click.Context(cli)
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        assert command is not None
        leaves = command.commands.values() if isinstance(command, click.Group) else [command]
        for leaf in leaves:
            flags = {flag for parameter in leaf.params for flag in parameter.opts}
            if not {"--json", "--quiet"} <= flags:
                without.add(name)
    # These print what others write, a script, or run until they are stopped.
    assert without == {"api", "completion", "logs", "serve", "view", "worker"}


def test_job_is_found_by_the_end_of_its_id() -> None:
    api: Any = FakeApi()
    assert find_job(api, short_id(IDS[2]))["id"] == IDS[2]
    assert find_job(api, "A2345")["id"] == IDS[1]
    assert find_job(api, "last")["id"] == IDS[0]
    assert api.asked[-1][0] == f"/v1/jobs/{IDS[0]}"  # whole, with notes and the place in the queue
    api.asked.clear()
    assert find_job(api, IDS[1])["id"] == IDS[1] and len(api.asked) == 1
    with pytest.raises(ConfigError, match="Several jobs"):
        find_job(api, "2345")
    with pytest.raises(ConfigError, match="no job whose id ends in beef"):
        find_job(api, "beef")
    with pytest.raises(ConfigError, match="at least the last 4"):
        find_job(api, "b")


def test_lists_take_as_many_requests_as_they_need() -> None:
    api: Any = FakeApi()
    assert [row["id"] for row in list_rows(api, "jobs")] == IDS
    assert [row["id"] for row in list_rows(api, "jobs", limit=1)] == IDS[:1]


def test_times_are_dates_of_this_machine() -> None:
    at = datetime(2026, 11, 26, 12, 30).astimezone()
    assert local_time(at.astimezone(UTC).isoformat()) == "2026-11-26 12:30"
    assert local_time(None) == ""


def test_help_groups_all_commands(octasplat) -> None:
    text = octasplat("--help").stdout
    assert text.index("From photographs to a scene:") < text.index("  reconstruct ")
    for name in cli.list_commands(click.Context(cli)):
        assert sum(line.startswith(f"  {name} ") for line in text.splitlines()) == 1, name


def test_version_names_what_results_depend_on(octasplat) -> None:
    lines = octasplat("--version").stdout.splitlines()
    assert lines[0].startswith("octasplat, version ") and lines[1].startswith("results version ")
    packages = {line.split(" ")[0] for line in lines}
    assert {"Python", "torch", "numba", "pycolmap"} <= packages


def test_cpu_features_are_read_where_the_system_tells_them(tmp_path: Path) -> None:
    told = tmp_path / "cpuinfo"
    told.write_text("processor : 0\nflags\t\t: fpu avx sse2 avx2 fma\n")
    assert cpu_features(told) == ("avx", "fma", "avx2")
    assert cpu_features(tmp_path / "none") == ()


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script_completes_commands(octasplat, shell: str, monkeypatch, capsys) -> None:
    script = octasplat("completion", shell)
    assert script.exit_code == 0 and f"_OCTASPLAT_COMPLETE={shell}_complete" in script.stdout
    monkeypatch.setenv("_OCTASPLAT_COMPLETE", f"{shell}_complete")
    monkeypatch.setenv("COMP_WORDS", "octasplat recon")
    monkeypatch.setenv("COMP_CWORD", "recon" if shell == "fish" else "1")
    with pytest.raises(SystemExit):
        main()
    assert "reconstruct" in capsys.readouterr().out


def test_summary_calls_files_what_they_are(tmp_path: Path) -> None:
    names = ("viewer.glb", "surface.glb", "octagons.ply", "scene.spz", "mesh.obj")
    for name in names:
        (tmp_path / name).touch()
    metrics = {"views": [], "mean": {}, "gaussians": 5, "iterations": 1, "seconds": 1.0}
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    lines = summarize_run(tmp_path, names)
    labels = {
        line.split(":")[1].strip().rpartition("/")[2]: line.split(":")[0] for line in lines if "/" in line
    }
    assert [labels[name] for name in names] == ["Viewer", "Surface", "Octagons", "Export", "Octagons"]


def test_client_commands_need_no_module_that_windows_lacks() -> None:
    program = """
import sys
for name in ("fcntl", "grp", "pwd", "resource", "termios"):
    sys.modules[name] = None
from click.testing import CliRunner
from octasplat.__main__ import cli
for command in (["jobs"], ["status", "last"], ["logs", "last"], ["cancel", "last"], ["retry", "last"],
                ["download", "last"], ["derive", "render", "last"], ["datasets"], ["workers"], ["open"]):
    found = CliRunner().invoke(cli, command)
    assert found.exit_code == 1 and "No service answers" in found.output, (command, found.output)
assert CliRunner().invoke(cli, ["config", "list"]).exit_code == 0
refused = CliRunner().invoke(cli, ["serve"])
assert refused.exit_code == 1 and "WSL" in refused.output, refused.output
"""
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "OCTASPLAT_SERVER": "http://127.0.0.1:9"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
