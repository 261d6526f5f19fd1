"""``stage init`` of a run with materials: lit by the light that the run has learnt, at every door."""

import shutil
from pathlib import Path

import pytest

import octasplat as osp
from octasplat.engine.core.psnr import psnr
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.pathtracing.stage.stage_file import read_stage
from octasplat.engine.render.image_files import read_image
from tests.cli.conftest import LIT_UP
from tests.cli.test_render_jobs import results_of

VIEW = ("--max-side", 48, "--photograph", "view_000.png", "--threads", 1)


def without_ball(stage: Path, samples: int = 64) -> None:
    """Take the meshes out of a stage."""
    text = stage.read_text().replace("samples = 16", f"samples = {samples}")
    start, end = text.index("[[meshes]]"), text.index("# A mirror for a floor.")
    stage.write_text(text[:start] + text[end:])


def test_stage_init_of_a_run_with_materials_shows_what_render_does(lit_run, octasplat, tmp_path):
    stage = tmp_path / "elsewhere" / "stage.toml"
    stage.parent.mkdir()
    done = octasplat("stage", "init", lit_run, "-o", stage)
    assert done.exit_code == 0, done.output
    read = read_stage(stage)
    assert read.gaussians[0].light == "relit" and read.environment is not None and read.lights == ()
    assert (stage.parent / read.environment.file).resolve() == (lit_run / "environment.exr").resolve()
    assert read.environment.up == tuple(LIT_UP) and not read.environment.visible
    assert "materials" in stage.read_text() and "learnt" in stage.read_text()
    without_ball(stage)
    turned = tmp_path / "elsewhere" / "turned.toml"
    turned.write_text(stage.read_text().replace("# rotation_degrees = 0.0 ", "rotation_degrees = 90.0 "))
    images = []
    for name, more in (("plain", ()), ("staged", ("--stage", stage)), ("turned", ("--stage", turned))):
        done = octasplat("render", lit_run, "-o", tmp_path / name, *VIEW, *more)
        assert done.exit_code == 0, done.output
        assert "materials are left out" not in done.output + done.stderr
        images.append(read_image(next((tmp_path / name).rglob("*.png")))[..., :3])
    near, far = psnr(images[0], images[1]), psnr(images[0], images[2])
    assert near > 26 and near > far + 3


def test_stage_init_of_a_runs_scene_file_takes_the_light_and_up_of_the_run(lit_run, octasplat, tmp_path):
    stages = [tmp_path / "run.toml", tmp_path / "file.toml"]
    for source, stage in zip((lit_run, lit_run / "scene.ply"), stages, strict=True):
        done = octasplat("stage", "init", source, "-o", stage)
        assert done.exit_code == 0, done.output
    assert stages[0].read_bytes() == stages[1].read_bytes()
    assert "which says what is up" in done.stderr
    # whoever says what is up of the file is heard
    done = octasplat("stage", "init", lit_run / "scene.ply", "--up", "x", "-o", tmp_path / "x.toml")
    assert done.exit_code == 0 and "A file does not say" not in done.stderr
    read = read_stage(tmp_path / "x.toml")
    assert read.up == (1, 0, 0) and read.environment is not None and read.environment.up == tuple(LIT_UP)


def test_stage_init_puts_the_light_beside_the_stage_when_asked(lit_run, octasplat, tmp_path):
    stage = tmp_path / "stage.toml"
    done = octasplat("stage", "init", lit_run, "-o", stage, "--copy-light")
    assert done.exit_code == 0, done.output
    assert 'file = "environment.exr"' in stage.read_text()
    assert (tmp_path / "environment.exr").read_bytes() == (lit_run / "environment.exr").read_bytes()
    # nobody's file is replaced
    (tmp_path / "environment.exr").write_bytes(b"mine")
    done = octasplat("stage", "init", lit_run, "-o", tmp_path / "other.toml", "--copy-light")
    assert done.exit_code == 1 and "is there already" in done.stderr
    assert (tmp_path / "environment.exr").read_bytes() == b"mine"


def test_stage_init_keeps_the_light_of_another_run(lit_run, octasplat, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(lit_run, other)
    (other / "environment.exr").write_bytes(b"of the other run")
    command = ("stage", "init", lit_run, "-o", other / "stage.toml", "--copy-light", "--overwrite")
    refused = octasplat(*command)
    assert refused.exit_code == 1 and "would take the place of that of the run" in refused.stderr
    assert (other / "environment.exr").read_bytes() == b"of the other run"
    assert not (other / "stage.toml").exists()


def test_stage_init_job_puts_the_light_beside_the_stage(lit_run, tmp_path):
    results = results_of("stage-init", lit_run, tmp_path / "attempt", {})
    assert {path.name for path in results.iterdir()} == {"stage.toml", "environment.exr"}
    read = read_stage(results / "stage.toml")
    assert read.gaussians[0].light == "relit" and read.environment is not None
    assert read.environment.file == "environment.exr" and read.environment.up == tuple(LIT_UP)
    assert (results / "environment.exr").read_bytes() == (lit_run / "environment.exr").read_bytes()


def test_stage_init_in_python_takes_the_light_of_the_run(lit_run, tmp_path):
    osp.stage_init(lit_run, tmp_path / "stage.toml")
    read = read_stage(tmp_path / "stage.toml")
    assert read.gaussians[0].light == "relit" and read.environment is not None


def spoil_run(lit_run: Path, folder: Path, case: str) -> tuple[Path, str]:
    """A copy of the run whose materials no stage can light by itself, and words on why."""
    run = folder / "run"
    shutil.copytree(lit_run, run)
    if case == "file":
        shutil.copy(run / "scene.ply", folder / "alone.ply")
        return folder / "alone.ply", "a file does not hold the light"
    if case == "some":
        gaussians, _ = read_gaussian_ply(run / "scene.ply")
        for values in gaussians.channels.values():
            values[0] = 0
        write_gaussian_ply(gaussians, run / "scene.ply")
        return run, "some of its Gaussians came from a scene without"
    if case in ("near_field", "ref_gaussian"):
        text = (run / "config.json").read_text().replace('"recipe": "split_sum"', f'"recipe": "{case}"')
        (run / "config.json").write_text(text)
        if case == "ref_gaussian":
            return run, "what is matt has its color from the harmonics"
        return run, "base colors hold the light of the photographs"
    for path in run.glob("environment.*"):
        path.unlink()
    return run, "the run holds no light"


@pytest.mark.parametrize("case", ["file", "some", "near_field", "ref_gaussian", "no_map"])
def test_stage_init_says_why_materials_are_not_shown(lit_run, octasplat, tmp_path, case):
    source, words = spoil_run(lit_run, tmp_path, case)
    done = octasplat("stage", "init", source, "-o", tmp_path / "stage.toml")
    if case == "no_map" and done.exit_code:
        assert "environment" in done.stderr and "Traceback" not in done.stderr
        return
    assert done.exit_code == 0, done.output
    told = " ".join(done.stderr.split())
    assert words in told and 'write light = "relit"' in told
    read = read_stage(tmp_path / "stage.toml")
    assert read.gaussians[0].light == "shadowed" and read.environment is None and len(read.lights) == 1
    assert words in " ".join((tmp_path / "stage.toml").read_text().replace("\n# ", " ").split())
