"""Help, version, and the way errors are told."""

import json
import subprocess
import sys

import click
import pytest

from octasplat.engine import __version__
from octasplat.engine.core.threads import available_threads
from octasplat.engine.files import exporters
from octasplat.workers.cli.main import cli

COMMANDS = ("reconstruct", "evaluate", "export", "render", "demo")
HEAVY = ("torch", "numba", "pycolmap", "numpy", "OpenImageIO", "scipy")


# The help of export lists the formats that the registry finds, which takes numpy.
LIGHT = [name for name in COMMANDS if name != "export"]


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], *([name, "--help"] for name in LIGHT)])
def test_help_loads_no_heavy_modules(arguments):
    # The options of a command are the fields of its request.
    unwanted = HEAVY if len(arguments) == 2 else (*HEAVY, "pydantic")
    code = f"""
import sys
from octasplat.workers.cli.main import cli
try:
    cli({arguments!r})
except SystemExit as end:
    assert end.code == 0
heavy = set({unwanted!r}) & set(sys.modules)
assert not heavy, heavy
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_help_names_every_command(octasplat):
    text = octasplat("--help").stdout
    assert all(name in text for name in COMMANDS)


def test_help_lists_each_command_with_its_own_line(octasplat):
    text = octasplat("--help").stdout
    with click.Context(cli) as context:
        for name in cli.list_commands(context):
            command = cli.get_command(context, name)
            assert command.name == name and f"{name} " in text
            assert " ".join(command.get_short_help_str(100).split()) in " ".join(text.split()), name


def test_help_of_export_names_every_format(octasplat):
    text = octasplat("export", "--help").stdout
    for exporter in exporters():
        assert exporter.name in text, exporter.name


def test_version_option_prints_package_version(octasplat):
    assert octasplat("--version").stdout.splitlines()[0] == f"octasplat, version {__version__}"


def one_error_line(result, code=1):
    """The message of a command that failed as it should."""
    assert result.exit_code == code, result.output
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("Error: "), result.stderr
    assert "Traceback" not in result.output
    return lines[0]


def test_reconstruct_missing_folder_is_named_in_error(octasplat, tmp_path):
    result = octasplat("reconstruct", tmp_path / "nowhere", "-o", tmp_path / "out")
    assert "nowhere" in one_error_line(result)


def test_reconstruct_folder_without_scene_is_refused(octasplat, tmp_path):
    (tmp_path / "empty").mkdir()
    result = octasplat("reconstruct", tmp_path / "empty", "-o", tmp_path / "out")
    assert "empty" in one_error_line(result)


def test_output_with_a_run_needs_resume(octasplat, run, tiny):
    result = octasplat("reconstruct", run.scene, "-o", run.output, *tiny)
    assert "--resume" in one_error_line(result)


def test_output_with_other_files(octasplat, run, tmp_path):
    (tmp_path / "diary.txt").write_text("dear diary")
    result = octasplat("reconstruct", run.scene, "-o", tmp_path)
    assert str(tmp_path) in one_error_line(result)
    assert [path.name for path in tmp_path.iterdir()] == ["diary.txt"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--set", "color=7"], "color"),
        (["--set", "lr.mean"], "name=value"),
        (["--set", "lr.mean=-1"], "mean"),
        (["--set", "train.lr.mean=-1"], "mean"),
        (["--set", "test_every=-1"], "test_every"),
        (["--iterations", "-1"], "iterations"),
    ],
)
def test_settings_out_of_range_or_unknown(octasplat, scene, tmp_path, arguments, word):
    result = octasplat("reconstruct", scene, "-o", tmp_path / "out", *arguments)
    assert word in one_error_line(result)
    assert not (tmp_path / "out").exists()


def test_unknown_preset_is_a_usage_error(octasplat, scene, tmp_path):
    result = octasplat("reconstruct", scene, "-o", tmp_path / "out", "--preset", "best")
    assert result.exit_code == 2
    assert "fast" in result.stderr


def test_unexpected_error_prints_one_line(octasplat, run, monkeypatch):
    monkeypatch.setattr("octasplat.engine.evaluate.run_evaluation.evaluate", _broken)
    monkeypatch.delenv("OCTASPLAT_DEBUG", raising=False)
    line = one_error_line(octasplat("evaluate", run.output), code=70)
    assert "ZeroDivisionError" in line and "OCTASPLAT_DEBUG=1" in line
    monkeypatch.setenv("OCTASPLAT_DEBUG", "1")
    result = octasplat("evaluate", run.output)
    assert result.exit_code == 70
    assert "Traceback" in result.stderr


def test_interrupted_commands_end_with_130(octasplat, run, monkeypatch):
    monkeypatch.setattr("octasplat.engine.evaluate.run_evaluation.evaluate", _interrupted)
    one_error_line(octasplat("evaluate", run.output), code=130)


def test_threads_are_capped_at_the_cores(octasplat, run, monkeypatch):
    asked = []

    def evaluate(output, **options):
        asked.append(options["threads"])
        return output / "metrics.json"

    monkeypatch.setattr("octasplat.engine.evaluate.run_evaluation.evaluate", evaluate)
    assert octasplat("evaluate", run.output, "--threads", "100000").exit_code == 0
    assert octasplat("evaluate", run.output, "--threads", "1").exit_code == 0
    assert asked == [available_threads(), 1]


def test_evaluate_folder_without_run_is_refused(octasplat, tmp_path):
    assert str(tmp_path) in one_error_line(octasplat("evaluate", tmp_path))


def test_evaluate_measures_the_same_again(octasplat, run):
    before = run.metrics()
    (run.output / "metrics.json").unlink()
    result = octasplat("evaluate", run.output)
    assert result.exit_code == 0, result.output
    assert run.metrics()["mean"] == before["mean"]
    assert f"PSNR {before['mean']['psnr']:.2f} dB" in result.stdout
    json.dumps(run.metrics(), allow_nan=False)


def _broken(*_arguments, **_options):
    raise ZeroDivisionError("two\nlines")


def _interrupted(*_arguments, **_options):
    raise KeyboardInterrupt
