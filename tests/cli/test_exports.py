"""Files that cannot be written are refused before the training, and cost nothing that can."""

import json
from pathlib import Path

import pytest


@pytest.fixture
def failing_converter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A splat-transform that is there and fails."""
    program = tmp_path / "splat-transform"
    program.write_text("#!/bin/sh\necho no WebGPU here >&2\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setenv("OCTASPLAT_SPLAT_TRANSFORM", str(program))


def test_unwritable_exports_are_refused_before_training(scene, octasplat, tiny, tmp_path, monkeypatch):
    monkeypatch.setenv("OCTASPLAT_SPLAT_TRANSFORM", str(tmp_path / "nothing"))
    output = tmp_path / "run"
    result = octasplat("reconstruct", scene, "-o", output, *tiny, "--exports", "mesh.glb,scene.sog")
    assert result.exit_code == 1 and not output.exists()
    assert "scene.sog: needs the program splat-transform; install" in result.stderr
    for name, words in (
        ("a.docx", "no export format"),
        ("scene.ply", "another result"),
        ("../a.ply", "name a file"),
    ):
        result = octasplat("reconstruct", scene, "-o", output, *tiny, "--exports", name)
        assert result.exit_code == 1 and words in result.stderr and not output.exists()


def test_failed_export_keeps_results_and_resumes_without_training(
    scene, octasplat, tiny, tmp_path, failing_converter
):
    output = tmp_path / "run"
    result = octasplat("reconstruct", scene, "-o", output, *tiny, "--exports", "a.sog,mesh.glb,mesh.ply")
    assert result.exit_code == 1
    assert (
        "1 of 3 files could not be written: a.sog: splat-transform failed (no WebGPU here)" in result.stderr
    )
    assert "--resume" in result.stderr and "PSNR" in result.stdout
    for name in ("scene.ply", "mesh.glb", "mesh.ply", "metrics.json", "report.html"):
        assert (output / name).stat().st_size > 0, name
    trained = (output / "scene.ply").stat()
    result = octasplat("reconstruct", scene, "-o", output, "--resume", "--exports", "mesh.glb,b.splat")
    assert result.exit_code == 0, result.output
    assert (output / "b.splat").exists() and (output / "scene.ply").stat() == trained
    kept = json.loads((output / "config.json").read_text())["reconstruction"]
    assert kept["exports"] == ["mesh.glb", "b.splat"] and kept["test_every"] == 4
