"""``reconstruct --materials``: what it leaves, and that a stopped run ends with the same bytes."""

import json
import shutil
import signal
import time
from dataclasses import replace

import numpy as np
import pytest

import octasplat as osp
from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.gaussians.materials import has_materials
from octasplat.engine.render.environment_files import read_environment, write_environment
from octasplat.engine.render.image_files import read_image
from octasplat.engine.render.path_document import read_path_document
from octasplat.engine.render.path_file import path_cameras
from tests.support.image_channels import read_channels
from tests.support.tiny_dataset import make_tiny_dataset

MATERIALS = (
    "--materials", "--set", "materials.environment_height=16", "--set", "materials.ambient_occlusion_rays=4",
    "--exports", "",
)  # fmt: skip


@pytest.fixture(scope="module")
def materials_run(scene, octasplat, tiny, tmp_path_factory):
    output = tmp_path_factory.mktemp("materials") / "run"
    result = octasplat("reconstruct", scene, "-o", output, *tiny, *MATERIALS)
    assert result.exit_code == 0, result.output
    return output


def test_materials_run_writes_channels_and_environment(materials_run):
    gaussians, _ = read_gaussian_ply(materials_run / "scene.ply")
    assert has_materials(gaussians)
    for values in gaussians.channels.values():
        assert values.min() >= 0 and values.max() <= 1
    assert np.ptp(gaussians.channels["albedo"]) > 0.02
    environment = read_environment(materials_run / "environment.hdr")
    assert environment.shape == (16, 32, 3) and np.ptp(environment) > 0
    exact = read_environment(materials_run / "environment.exr")
    assert (np.abs(environment - exact) <= exact.max(axis=2, keepdims=True) / 255).all()
    train = json.loads((materials_run / "config.json").read_text())["reconstruction"]["train"]
    assert train["materials"]["learn"] is True and train["lr"]["quat"] < 0.01


def test_materials_run_evaluates_shaded_images(materials_run, octasplat):
    before = json.loads((materials_run / "metrics.json").read_text())
    result = octasplat("evaluate", materials_run)
    assert result.exit_code == 0, result.output
    assert json.loads((materials_run / "metrics.json").read_text())["mean"] == before["mean"]
    for suffix in (".hdr", ".exr"):
        (materials_run / f"environment{suffix}").rename(materials_run / f"away{suffix}")
    result = octasplat("evaluate", materials_run)
    for suffix in (".hdr", ".exr"):
        (materials_run / f"away{suffix}").rename(materials_run / f"environment{suffix}")
    assert result.exit_code != 0 and "environment.hdr" in result.output
    assert "Traceback" not in result.output


@pytest.mark.exhaustive
def test_materials_run_resumes_to_same_bytes(
    materials_run, scene, start_octasplat, tiny, octasplat, tmp_path
):
    output = tmp_path / "run"
    command = ("reconstruct", scene, "-o", output, *tiny, *MATERIALS)
    running = start_octasplat(*command)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and running.poll() is None:
        told = output / "events.jsonl"
        if told.exists() and '"iteration": 20' in told.read_text():
            running.send_signal(signal.SIGINT)
            break
        time.sleep(0.01)
    running.communicate(timeout=120)
    result = octasplat(*command, "--resume")
    assert result.exit_code == 0, result.output
    for name in ("scene.ply", "environment.hdr", "environment.exr", "residual.npz"):
        assert (output / name).read_bytes() == (materials_run / name).read_bytes(), name


def test_render_of_materials_run_is_shaded_as_its_evaluation(materials_run, octasplat, tmp_path):
    result = octasplat("render", materials_run, "-o", tmp_path / "shaded")
    assert result.exit_code == 0, result.output
    rendered = sorted((tmp_path / "shaded").glob("*.png"))
    assert rendered, "the run holds out views"
    for path in rendered:
        assert path.read_bytes() == (materials_run / "renders" / path.name).read_bytes()
    result = octasplat("render", materials_run, "--shading", "harmonics", "-o", tmp_path / "plain")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "plain" / rendered[0].name).read_bytes() != rendered[0].read_bytes()


def test_residual_colors_are_shown_in_the_learnt_light_alone(materials_run, octasplat, tmp_path):
    run = shutil.copytree(materials_run, tmp_path / "run")
    residual = run / "residual.npz"
    with np.load(residual) as stored:
        assert len(stored["sh"]) == len(read_gaussian_ply(run / "scene.ply")[0])
    camera = ("--camera", 0, -0.5, -2.5, "--width", 32, "--height", 24)
    light = ("--environment", run / "environment.hdr")

    def picture(name, *command):
        result = octasplat(*command, *camera, "-o", tmp_path / f"{name}.png")
        assert result.exit_code == 0, result.output
        return read_image(tmp_path / f"{name}.png")

    shown, relit = picture("shown", "render", run), picture("relit", "relight", run, *light)
    # an edit leaves them out, and says so
    result = octasplat("crop", run, "--box", -100, -100, -100, 100, 100, 100, "-o", tmp_path / "cropped")
    assert result.exit_code == 0 and "residual colors" in " ".join(result.output.split())
    cropped = picture("cropped", "render", tmp_path / "cropped")
    result = octasplat("crop", tmp_path / "cropped", "--box", -99, -99, -99, 99, 99, 99, "-o", tmp_path / "c")
    assert result.exit_code == 0 and "residual colors" not in " ".join(result.output.split())
    whole = residual.read_bytes()
    residual.write_bytes(whole[:100])
    result = octasplat("render", run, *camera, "-o", tmp_path / "damaged.png")
    assert result.exit_code == 1 and "residual.npz cannot be read" in " ".join(result.output.split())
    residual.unlink()
    np.testing.assert_array_equal(picture("without", "render", run), cropped)
    np.testing.assert_array_equal(picture("relit again", "relight", run, *light), relit)
    assert np.abs(shown - cropped).max() > 0.01


def test_residual_colors_follow_the_rows_of_the_scene_that_are_read(materials_run, tmp_path):
    run = shutil.copytree(materials_run, tmp_path / "run")
    whole = osp.load(run)
    assert whole.residual_sh is not None
    # of another program: not finite here, rows reordered there
    bad, content = [3, 10], (run / "scene.ply").read_bytes()
    for row in bad:
        content = content.replace(whole.means[row].tobytes(), np.float32([0, np.nan, 0]).tobytes(), 1)
    (run / "scene.ply").write_bytes(content)
    with pytest.raises(osp.OctasplatError, match="2 of"):
        osp.load(run)
    kept = osp.load(run, drop_invalid=True)
    np.testing.assert_array_equal(kept.residual_sh, np.delete(whole.residual_sh, bad, axis=0))
    osp.save(whole.select(np.arange(len(whole))[::-1]), run / "scene.ply")
    with pytest.raises(osp.ConfigError, match=r"residual\.npz does not belong to the scene"):
        osp.load(run)


@pytest.mark.exhaustive
def test_near_field_run_is_rendered_as_evaluated_and_relit_with_a_warning(scene, octasplat, tiny, tmp_path):
    near = ("--set", "materials.recipe=near_field")
    result = octasplat("reconstruct", scene, "-o", tmp_path / "run", *tiny, *MATERIALS, *near)
    assert result.exit_code == 0, result.output
    gaussians, _ = read_gaussian_ply(tmp_path / "run" / "scene.ply")
    assert has_materials(gaussians) and "bounced" not in gaussians.channels
    assert octasplat("render", tmp_path / "run", "-o", tmp_path / "views").exit_code == 0
    evaluated = sorted((tmp_path / "run" / "renders").glob("*.png"))
    assert evaluated
    for path in evaluated:
        np.testing.assert_array_equal(read_image(tmp_path / "views" / path.name), read_image(path))
    light = ("--environment", tmp_path / "run" / "environment.hdr")
    result = octasplat("relight", tmp_path / "run", *light, "-o", tmp_path / "relit")
    assert result.exit_code == 0, result.output
    assert "hold the light of the photographs" in " ".join(result.output.split())


@pytest.mark.exhaustive
def test_exr_of_materials_run_keeps_radiance_above_white(materials_run, octasplat, tmp_path):
    """A PNG of the same picture is clipped."""
    bright = tmp_path / "bright"
    shutil.copytree(materials_run, bright)
    light = np.full((16, 32, 3), 4.0, np.float32)
    write_environment(bright / "environment.exr", light)
    camera = ("--camera", 0, -0.5, -2.5, "--width", 32, "--height", 24)
    result = octasplat("render", bright, *camera, "-o", tmp_path / "a.exr")
    assert result.exit_code == 0, result.output
    channels = read_channels(tmp_path / "a.exr")
    assert channels["R"].max() > 1.5
    result = octasplat("render", bright, *camera, "-o", tmp_path / "a.png")
    assert result.exit_code == 0, result.output
    # over black: alpha times the display value, which is 1 at most
    clipped = np.minimum(linear_to_srgb(channels["R"]), channels["A"])
    assert np.abs(read_image(tmp_path / "a.png")[..., 0] - clipped).max() < 1 / 255


@pytest.mark.exhaustive
def test_scene_of_materials_run_in_memory_shows_materials(materials_run, octasplat, tmp_path):
    """The same picture as that of the command, also of a copy; harmonics where they are asked for."""
    pose = [[1, 0, 0, 0], [0, 1, 0, -0.5], [0, 0, 1, -2.5], [0, 0, 0, 1]]
    frames = [{"camera_to_world": pose, "fov_y_degrees": 50}]
    (tmp_path / "path.json").write_text(json.dumps({"width": 64, "height": 48, "frames": frames}))
    scene = osp.load(materials_run)
    [given] = path_cameras(read_path_document(tmp_path / "path.json"), "path.json").cameras
    camera = replace(given, near_world=scene.facts.near_world)
    pictures = []
    for shading in ("materials", "harmonics"):
        output = tmp_path / f"{shading}.png"
        command = ("render", materials_run, "--path", tmp_path / "path.json", "--shading", shading)
        result = octasplat(*command, "-o", output)
        assert result.exit_code == 0, result.output
        osp.render(scene.copy(), camera, shading=shading).save(tmp_path / "memory.png")
        assert (tmp_path / "memory.png").read_bytes() == output.read_bytes()
        pictures.append(output.read_bytes())
    osp.render(scene, camera).save(tmp_path / "default.png")
    assert (tmp_path / "default.png").read_bytes() == pictures[0] != pictures[1]
    of_file = osp.load(materials_run / "scene.ply")
    osp.render(of_file, camera).save(tmp_path / "file.png")
    assert (tmp_path / "file.png").read_bytes() == pictures[1]
    with pytest.raises(osp.ConfigError, match="no materials with a light"):
        osp.render(of_file, camera, shading="materials")


def test_render_says_where_materials_cannot_be_shown(materials_run, octasplat, tmp_path):
    camera = ("--turntable", "--frames", "1", "--width", "32", "--height", "24")
    scene = materials_run / "scene.ply"
    result = octasplat("render", scene, *camera, "-o", tmp_path / "file.png")
    assert result.exit_code == 0 and "octasplat relight shows its materials" in " ".join(
        result.output.split()
    )
    result = octasplat("render", scene, *camera, "--shading", "materials", "-o", tmp_path / "none.png")
    assert result.exit_code == 1 and "does not hold the light" in " ".join(result.output.split())
    assert not (tmp_path / "none.png").exists()


@pytest.mark.exhaustive
def test_render_of_plain_run_refuses_materials(run, octasplat, tmp_path):
    result = octasplat("render", run.output, "--shading", "materials", "-o", tmp_path / "views")
    assert result.exit_code == 1 and "has learnt no materials" in " ".join(result.output.split())


def test_run_merged_with_scene_without_materials_shows_harmonics(materials_run, run, octasplat, tmp_path):
    merged = tmp_path / "merged"
    result = octasplat("merge", materials_run, run.output / "scene.ply", "-o", merged)
    assert result.exit_code == 0, result.output
    for name, more in (("by_default", ()), ("harmonics", ("--shading", "harmonics"))):
        result = octasplat("render", merged, *more, "-o", tmp_path / name)
        assert result.exit_code == 0, result.output
        assert ("came from a scene without materials" in " ".join(result.output.split())) == (not more)
    for path in (tmp_path / "harmonics").glob("*.png"):
        assert (tmp_path / "by_default" / path.name).read_bytes() == path.read_bytes()
    result = octasplat("evaluate", merged)
    assert result.exit_code == 0, result.output
    for path in (merged / "renders").glob("*.png"):
        assert path.read_bytes() == (tmp_path / "harmonics" / path.name).read_bytes()


@pytest.mark.exhaustive
def test_cameras_of_other_photographs_change_no_shading(materials_run, octasplat, tmp_path, tmp_path_factory):
    """The extent by which reflections keep off surfaces is that of the training."""
    few = make_tiny_dataset(tmp_path_factory, views=3)
    pose = [[1, 0, 0, 0], [0, 1, 0, -0.5], [0, 0, 1, -2.5], [0, 0, 0, 1]]
    frames = [{"camera_to_world": pose, "fov_y_degrees": 50}]
    (tmp_path / "path.json").write_text(json.dumps({"width": 64, "height": 48, "frames": frames}))
    cameras = ("--path", tmp_path / "path.json")
    light = ("--environment", materials_run / "environment.hdr", "--integrator", "split-sum")
    for verb, options in (("render", ()), ("relight", light)):
        found = []
        for more in ((), ("--dataset", few)):
            output = tmp_path / f"{verb}{len(found)}.exr"
            result = octasplat(verb, materials_run, *cameras, *options, *more, "-o", output)
            assert result.exit_code == 0, result.output
            found.append(output.read_bytes())
        assert found[0] == found[1], verb


@pytest.mark.exhaustive
def test_training_views_are_measured_with_residual_colors(materials_run, scene, octasplat, tiny, tmp_path):
    """As held-out views are, beside which the report puts them."""
    without = tmp_path / "without"
    given = ("--set", "materials.residual_share=0")
    result = octasplat("reconstruct", scene, "-o", without, *tiny, *MATERIALS, *given)
    assert result.exit_code == 0, result.output
    assert (without / "scene.ply").read_bytes() == (materials_run / "scene.ply").read_bytes()
    assert not (without / "residual.npz").exists()
    shown, plain = (
        json.loads((run / "training.json").read_text())["training_views"] for run in (materials_run, without)
    )
    assert shown["psnr"] > plain["psnr"] + 0.1
    assert shown["misfits"] == plain["misfits"]
