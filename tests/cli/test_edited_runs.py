"""Commands that change the scene of a run write a folder that is a run again."""

import json
import shutil

import numpy as np
import pycolmap
import pytest

import octasplat as osp
from octasplat.engine.dataset.views_file import read_views
from octasplat.engine.edit.run_transform import rotate_environment
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.render.environment_files import (
    read_environment,
    write_background_map,
    write_environment,
)
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import run_camera_clearance
from octasplat.engine.shading.environment_frame import environment_frame

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # 90 degrees about z


def names(folder):
    return {path.name for path in folder.iterdir()}


def seen_from(run, views):
    """Where the Gaussians are in the cameras of the views."""
    means = read_gaussian_ply(run / "scene.ply")[0].means_world.astype(np.float64)
    return [means @ view.rotation_cam_from_world.T + view.translation_cam_from_world for view in views]


def test_transformed_run_keeps_relative_cameras(shiny_run, octasplat, tmp_path):
    shiny_run = shutil.copytree(shiny_run, tmp_path / "run")
    radiance = np.random.default_rng(0).random((16, 32, 3)).astype(np.float32)
    write_environment(shiny_run / "environment.hdr", radiance)
    write_background_map(shiny_run / "background.exr", radiance)
    move = ("--rotate", "z", 90, "--scale", 2, "--translate", 3, -4, 5)
    done = octasplat("transform", shiny_run, *move, "-o", tmp_path / "moved")
    assert done.exit_code == 0, done.output
    assert "environment.hdr was turned with the scene" in done.stderr
    kept = {"config.json", "held_out.json", "views.json", "training.json", "events.jsonl", "scene.ply"}
    assert names(tmp_path / "moved") == {
        *kept,
        "environment.exr",
        "environment.hdr",
        "background.exr",
        "edits.json",
    }
    old, new = (read_views(run / "views.json").viewpoints(None) for run in (shiny_run, tmp_path / "moved"))
    assert new.extent == pytest.approx(2 * old.extent)
    for before, after in zip(
        seen_from(shiny_run, old.views), seen_from(tmp_path / "moved", new.views), strict=True
    ):
        np.testing.assert_allclose(after, 2 * before, atol=1e-4)
    zones = [run_camera_clearance(run, 0.25) for run in (shiny_run, tmp_path / "moved")]
    assert zones[0] is not None and zones[1] is not None
    np.testing.assert_allclose(zones[1].radii, 2 * zones[0].radii, rtol=1e-6)
    # Light: up is turned along, and what stood in a direction stands in the turned one.
    up, turned_up = (
        read_config(run / "config.json").train.materials.up_world for run in (shiny_run, tmp_path / "moved")
    )
    np.testing.assert_allclose(turned_up, TURN @ up, atol=1e-12)
    frames = [environment_frame(np.array(each)) for each in (up, turned_up)]
    held = read_environment(shiny_run / "environment.hdr")
    want = rotate_environment(held, *frames, TURN)
    np.testing.assert_allclose(
        read_environment(tmp_path / "moved" / "environment.hdr"), want, rtol=0.02, atol=0.01
    )
    # The photographs are in the old world, so that nothing may be measured with their model.
    content = json.loads((tmp_path / "moved" / "config.json").read_text())
    assert content["scene"] == json.loads((shiny_run / "config.json").read_text())["scene"].rpartition("/")[2]
    refused = octasplat("evaluate", tmp_path / "moved")
    assert refused.exit_code == 1 and "--dataset FOLDER" in refused.stderr
    photographs = json.loads((shiny_run / "config.json").read_text())["scene"]
    for more in (
        ("--dataset", photographs),
        ("--other-dataset", photographs),
        ("--dataset", photographs, "--all-views"),
    ):
        refused = octasplat("evaluate", tmp_path / "moved", *more)
        assert refused.exit_code == 1 and "same world" in refused.stderr, refused.output
        assert not (tmp_path / "moved" / "metrics.json").exists()


def test_transformed_run_of_a_region_is_measured(run, octasplat, tmp_path):
    trained = shutil.copytree(run.output, tmp_path / "run", ignore=shutil.ignore_patterns("on", "cache"))
    content = json.loads((trained / "config.json").read_text())
    content["reconstruction"]["region"] = [-0.2, -0.2, -0.2, 0.2, 0.2, 0.2]
    (trained / "config.json").write_text(json.dumps(content))
    moved, photographs = tmp_path / "moved", shutil.copytree(run.scene, tmp_path / "photographs")
    assert octasplat("transform", trained, "--translate", 50, 0, 0, "-o", moved).exit_code == 0
    model = pycolmap.Reconstruction(photographs / "sparse" / "0")
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), [50.0, 0.0, 0.0]))
    model.write(photographs / "sparse" / "0")
    done = octasplat("evaluate", moved, "--dataset", photographs, "--threads", 1)
    assert done.exit_code == 0, done.output
    psnr = json.loads((moved / "metrics.json").read_text())["mean"]["psnr"]
    assert psnr == pytest.approx(run.metrics()["mean"]["psnr"], abs=0.02)


def test_transformed_run_rotates_environment():
    up = np.array([0.3, -1.0, 0.2])
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    frames = environment_frame(up), environment_frame(turn @ up)
    height = 32
    down, round_ = (
        (np.arange(height) + 0.5) * np.pi / height,
        (np.arange(2 * height) + 0.5) * np.pi / height - np.pi,
    )
    directions = np.stack(
        [
            np.sin(down)[:, None] * np.sin(round_),
            np.broadcast_to(np.cos(down)[:, None], (height, 2 * height)),
            np.sin(down)[:, None] * np.cos(round_),
        ],
        axis=-1,
    )
    values = (0.5 + 0.5 * directions @ frames[0]).astype(np.float32)  # the color of a direction is itself
    want = 0.5 + 0.5 * (directions @ frames[1]) @ turn
    np.testing.assert_allclose(rotate_environment(values, *frames, turn), want, atol=0.003)


def test_transform_with_shear_writes_scene_only(run, octasplat, tmp_path):
    (tmp_path / "matrix.txt").write_text("1 0.5 0 0  0 1 0 0  0 0 1 0")
    for arguments in (("--matrix", tmp_path / "matrix.txt"), ("--scale", -1)):
        done = octasplat("transform", run.output, *arguments, "-o", tmp_path / "out")
        assert (
            done.exit_code == 0 and "holds the scene alone" in done.stderr and "a scene with" in done.stdout
        ), done.output
        assert names(tmp_path / "out") == {"scene.ply", "edits.json"}
        for path in (tmp_path / "out").iterdir():
            path.unlink()


def test_scene_that_a_transform_left_alone_is_shown(shiny_run, octasplat, tmp_path):
    alone = tmp_path / "alone"
    assert octasplat("transform", shiny_run, "--scale", -1, "-o", alone).exit_code == 0
    small = ("--width", 32, "--height", 32, "--threads", 1)
    for command in (
        ("info", alone),
        ("render", alone, "--frames", 2, *small, "-o", tmp_path / "around"),
        ("render", alone, "--camera", 0, 0, -4, *small, "-o", tmp_path / "one.png"),
        ("stage", "init", alone, "-o", tmp_path / "stage.toml"),
        ("export", alone, tmp_path / "octagons.obj"),
    ):
        done = octasplat(*command)
        assert done.exit_code == 0 and "config.json" not in done.output, done.output
    assert len(list((tmp_path / "around").iterdir())) == 2
    refused = octasplat("render", alone, "--views", "all", "-o", tmp_path / "views")
    assert refused.exit_code == 2 and "views of photographs need the folder of a run" in refused.stderr
    assert osp.load(alone).materials is None


def test_crop_clean_merge_record_edits_in_run(run, octasplat, tmp_path):
    first, second, third = (tmp_path / name for name in ("a", "b", "c"))
    assert octasplat("crop", run.output, "--where", "x > 0", "-o", first).exit_code == 0
    assert octasplat("clean", first, "--no-floaters", "--min-opacity", 0.05, "-o", second).exit_code == 0
    assert octasplat("merge", second, run.output / "scene.ply", "-o", third).exit_code == 0
    for name in ("config.json", "views.json", "held_out.json"):
        assert (third / name).read_bytes() == (run.output / name).read_bytes()
    assert not (third / "metrics.json").exists()
    # how well the trained scene showed its views says nothing of what is left
    training, kept = (json.loads((path / "training.json").read_text()) for path in (run.output, third))
    assert kept == {name: fact for name, fact in training.items() if name != "training_views"} != training
    done = octasplat("evaluate", first, "--threads", 1)
    assert done.exit_code == 0 and "training views" not in done.output, done.output
    crop, clean, merge = json.loads((third / "edits.json").read_text())
    assert crop["operation"] == "crop" and crop["where"] == "x > 0"
    assert clean["min_opacity"] == 0.05 and clean["floaters"] is False
    assert merge["scenes"] == ["scene.ply"]
    count = len(read_gaussian_ply(run.output / "scene.ply")[0])
    assert merge["gaussians"] == clean["gaussians"] + count == len(read_gaussian_ply(third / "scene.ply")[0])
    refused = octasplat("crop", run.output, "--where", "x > 0", "-o", first)
    assert refused.exit_code == 1 and "is there already" in refused.stderr
