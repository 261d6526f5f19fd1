"""A run that learns what is far away keeps it in a file, and everything that shows the run shows it."""

import json
import shutil

import numpy as np
import pytest

from octasplat.engine.render.environment_files import read_background_map
from octasplat.engine.render.image_files import read_image

LEARNT = ("--set", "background=learnt", "--set", "background_height=32")


@pytest.fixture(scope="module")
def far_run(scene, octasplat, tiny, tmp_path_factory):
    output = tmp_path_factory.mktemp("far") / "run"
    result = octasplat("reconstruct", scene, "-o", output, *tiny, *LEARNT, "--exports", "mesh.ply")
    assert result.exit_code == 0, result.output
    assert "background.exr" in result.output  # no mesh carries it, which is said
    return output


def test_background_file_holds_trained_background(far_run, octasplat, tmp_path):
    colors = read_background_map(far_run / "background.exr")
    assert colors.shape == (32, 64, 3) and 0 <= colors.min() < colors.max() <= 1
    copied = tmp_path / "run"
    shutil.copytree(far_run, copied)
    before = json.loads((copied / "metrics.json").read_text())["mean"]["psnr"]
    assert octasplat("evaluate", copied, "--threads", 1).exit_code == 0
    assert json.loads((copied / "metrics.json").read_text())["mean"]["psnr"] == pytest.approx(
        before, abs=1e-4
    )
    assert 'id="background"' in (copied / "report.html").read_text()
    (copied / "background.exr").unlink()
    result = octasplat("evaluate", copied, "--threads", 1)
    assert result.exit_code != 0 and "background.exr" in result.output


def test_render_uses_trained_background_by_default(far_run, octasplat, tmp_path):
    name = sorted(path.name for path in (far_run / "renders").iterdir())[0]
    shown = {}
    for background in (None, "black", "transparent"):
        asked = () if background is None else ("--background", background)
        folder = tmp_path / str(background)
        result = octasplat("render", far_run, "-o", folder, "--views", "held-out", "--threads", 1, *asked)
        assert result.exit_code == 0, result.output
        shown[background] = read_image(folder / name)
    np.testing.assert_allclose(shown[None], read_image(far_run / "renders" / name), atol=1.01 / 255)
    alpha = shown["transparent"][..., 3]
    assert (shown[None] >= shown["black"] - 1.01 / 255).all()
    beside = alpha < 0.9
    assert (shown[None] - shown["black"])[beside].mean() > 0


def test_export_and_clean_mention_background_file(far_run, run, octasplat, tmp_path):
    for source, told in ((far_run, True), (run.output, False)):
        for command in ("export", "clean"):
            asked = (tmp_path / f"{command}.spz",) if command == "export" else ("--dry-run",)
            result = octasplat(command, source, *asked)
            assert result.exit_code == 0, result.output
            assert ("background.exr" in result.output) is told


def test_resumed_run_has_same_background(far_run, scene, octasplat, tiny, tmp_path):
    other = tmp_path / "run"
    shutil.copytree(far_run, other)
    for path in ("scene.ply", "background.exr", "metrics.json", "training.json"):
        (other / path).unlink()
    result = octasplat("reconstruct", scene, "-o", other, *tiny, *LEARNT, "--exports", "mesh.ply", "--resume")
    assert result.exit_code == 0, result.output
    for path in ("scene.ply", "background.exr"):
        assert (other / path).read_bytes() == (far_run / path).read_bytes()
