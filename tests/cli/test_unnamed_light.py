"""Stages that name no ``light`` for their scene: materials where these can be lit, at every door."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import octasplat as osp
from octasplat.engine.core.errors import CancelledError, ConfigError
from octasplat.engine.core.events import ImagesSaved, Noted
from octasplat.engine.core.psnr import psnr
from octasplat.engine.operations.registry import operation
from octasplat.engine.operations.render import RenderRequest
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.image_files import read_image
from octasplat.engine.runs.run_folder import run_viewpoints
from octasplat.workers.client.submission import Derivation, with_stage
from tests.cli.conftest import LIT_UP
from tests.cli.test_render_jobs import results_of
from tests.cli.test_stage_of_materials import VIEW, spoil_run

FEW = "[integrator]\nsamples = 2\n"
SHADOWED = "[[gaussians]]\nlight = 'shadowed'\n" + FEW
ONE = ("--turntable", "--frames", 1, "--width", 24, "--height", 18, "--threads", 1)
TOLD = "the stage names no light for the scene, so that materials are shown"
LEFT_OUT = "So the stage shows its harmonics."


def spelled_out(run: Path) -> str:
    """What a stage of a run says that leaves nothing to be chosen."""
    light = (run / "environment.exr").as_posix()
    return (
        f"[[gaussians]]\nlight = 'relit'\n[environment]\nfile = '{light}'\nup = {LIT_UP}\nvisible = false\n"
    )


@pytest.fixture
def picture(octasplat, tmp_path):
    """Renders a scene on a stage of this text; returns the picture's file, and what was said."""

    def render(source: Path, text: str | None, name: str, cameras: tuple = VIEW) -> tuple[Path, str]:
        more = ()
        if text is not None:
            (tmp_path / f"{name}.toml").write_text(text)
            more = ("--stage", tmp_path / f"{name}.toml")
        done = octasplat("render", source, "-o", tmp_path / name, *cameras, *more)
        assert done.exit_code == 0, done.output
        return next((tmp_path / name).rglob("*.png")), " ".join(done.stderr.split())

    return render


def test_scene_of_a_run_is_shown_with_its_materials(lit_run, picture):
    many = FEW.replace("2", "32")
    plain, _ = picture(lit_run, None, "plain")
    unnamed, told = picture(lit_run, many, "unnamed")
    by_name, _ = picture(lit_run, spelled_out(lit_run) + many, "by_name")
    shadowed, told_of_shadowed = picture(lit_run, SHADOWED.replace("2", "32"), "shadowed")
    assert unnamed.read_bytes() == by_name.read_bytes()
    near, far = (psnr(read_image(plain), read_image(path)) for path in (unnamed, shadowed))
    assert near > 26 and near > far + 3
    assert TOLD in told and "that was learnt with them" in told and told.count("materials") < 3
    assert "materials are left out on this stage" in told_of_shadowed and TOLD not in told_of_shadowed
    # an entry that says other things is one without light, too
    other, _ = picture(lit_run, f"[[gaussians]]\nambient = 0.7\n{many}", "other")
    assert other.read_bytes() == unnamed.read_bytes()


def test_surroundings_of_the_stage_light_materials_in_place_of_the_learnt_ones(lit_run, picture, tmp_path):
    write_environment(tmp_path / "sky.hdr", np.full((4, 8, 3), 0.3, np.float32))
    sky = "[environment]\nfile = 'sky.hdr'\n" + FEW
    unnamed, told = picture(lit_run, sky, "unnamed")
    by_name, _ = picture(lit_run, "[[gaussians]]\nlight = 'relit'\n" + sky, "by_name")
    assert unnamed.read_bytes() == by_name.read_bytes() and "of the stage's environment" in told


def test_scene_file_of_a_run_is_shown_in_the_light_of_the_run(lit_run, picture):
    unnamed, told = picture(lit_run / "scene.ply", FEW, "unnamed", ONE)
    by_name, _ = picture(lit_run / "scene.ply", spelled_out(lit_run) + FEW, "by_name", ONE)
    assert unnamed.read_bytes() == by_name.read_bytes() and TOLD in told


def test_jobs_and_python_give_the_bytes_of_the_command(lit_run, picture, tmp_path):
    command, _ = picture(lit_run, FEW, "command")
    asked = {"photographs": ["view_000.png"], "max_side": 48, "mode": "views", "format": "png"}
    job = results_of("render", lit_run, tmp_path / "attempt", {**asked, "stage": FEW})
    heard: list[object] = []
    osp.render(lit_run, tmp_path / "python", **asked, stage=FEW, threads=1, progress=heard.append)
    for folder in (job, tmp_path / "python"):
        assert next(folder.rglob("*.png")).read_bytes() == command.read_bytes()
    assert any(isinstance(event, Noted) and TOLD in event.message for event in heard)


def test_render_in_the_learnt_light_goes_on_elsewhere_but_not_in_another_light(lit_run, tmp_path):
    names, heard = [view.name for view in run_viewpoints(lit_run).views][:2], []
    runs = [lit_run, tmp_path / "moved", tmp_path / "relit"]
    for copied in runs[1:]:
        shutil.copytree(lit_run, copied)
    write_environment(runs[2] / "environment.exr", np.full((4, 8, 3), 0.3, np.float32))
    options = {"output": tmp_path / "views", "photographs": names, "max_side": 16, "stage": FEW}
    requests = [RenderRequest(source=each, **options) for each in runs]
    with pytest.raises(CancelledError):
        operation("render").run(
            requests[0],
            progress=heard.append,
            should_stop=lambda: any(isinstance(event, ImagesSaved) for event in heard),
        )
    again = [request.model_copy(update={"resume": True}) for request in requests]
    with pytest.raises(ConfigError, match="another render"):
        operation("render").run(again[2])
    operation("render").run(again[1])
    assert len(list((tmp_path / "views").glob("*.png"))) == 2


@pytest.mark.parametrize("case", ["file", "some", "near_field", "ref_gaussian", "no_map", "only_shadows"])
def test_one_line_says_why_materials_are_not_shown(lit_run, picture, tmp_path, case):
    lamp = ""
    if case == "only_shadows":
        source, words = lit_run, "the shadows of lights[0] (only_shadows) do not fall on materials."
        lamp = (
            "[[lights]]\nkind = 'directional'\ndirection = [0, 1, 0]\nirradiance = 1\nonly_shadows = true\n"
        )
    else:
        source, words = spoil_run(lit_run, tmp_path, case)
    cameras = ONE if source.is_file() else VIEW
    unnamed, told = picture(source, lamp + FEW, "unnamed", cameras)
    shadowed, _ = picture(source, SHADOWED + lamp, "shadowed", cameras)
    assert unnamed.read_bytes() == shadowed.read_bytes()
    assert words in told and told.count(LEFT_OUT) == 1 and "materials are left out" not in told


def test_scene_without_materials_keeps_its_bytes_and_nothing_is_said(run, picture):
    lamp = "[[lights]]\nkind = 'directional'\ndirection = [0, 1, 0]\nirradiance = 1\n"
    cameras = ("--max-side", 48, "--views", "held-out", "--threads", 1)
    unnamed, told = picture(run.output, FEW + lamp, "unnamed", cameras)
    shadowed, _ = picture(run.output, SHADOWED + lamp, "shadowed", cameras)
    assert unnamed.read_bytes() == shadowed.read_bytes()
    assert "light" not in told and "materials" not in told


def test_file_that_the_stage_adds_is_shown_with_harmonics_and_says_so(lit_run, picture, tmp_path):
    shutil.copy(lit_run / "scene.ply", tmp_path / "other.ply")
    both = "[[gaussians]]\n[[gaussians]]\nfile = 'other.ply'\nposition = [5, 0, 0]\n"
    unnamed, told = picture(lit_run, both + FEW, "unnamed")
    by_name, told_by_name = picture(lit_run, f"{both}light = 'shadowed'\n{FEW}", "by_name")
    assert unnamed.read_bytes() == by_name.read_bytes()
    assert "gaussians[1]: other.ply: a file does not hold the light" in told and TOLD in told
    assert LEFT_OUT not in told_by_name


def test_stage_of_a_job_says_no_light_where_its_file_does_not(tmp_path):
    (tmp_path / "a.toml").write_text(FEW)
    sent = with_stage(Derivation("", "render"), tmp_path / "a.toml").options["stage"]
    # services and workers of former versions take no null
    assert "light" not in json.dumps(sent["gaussians"])
