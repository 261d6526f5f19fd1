"""Settings that were asked for by name stay where a run is trained without its materials."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from click.testing import CliRunner

import octasplat as osp
from octasplat.engine.pipeline import material_choice
from octasplat.workers.cli.main import cli
from tests.support.tiny_dataset import make_tiny_dataset
from tests.support.unexplained_photographs import patched_trials

FEW = ["iterations=2", "initial_points=50", "max_gaussians=100", "test_every=4"]
OPTIONS: dict[str, Any] = {"preset": "fast", "exports": [], "set": FEW, "threads": 1}
LIKE_MATERIALS: dict[str, Any] = {"rays_per_batch": 8192}
"""What materials bring anyway, and the preset without them does not."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, width_px=24, height_px=18)


@pytest.fixture(autouse=True)
def trials() -> Iterator[None]:
    with patched_trials():
        yield


@pytest.fixture(scope="module")
def plain(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Scenes of runs without materials: with the setting and without it."""
    folder = tmp_path_factory.mktemp("plain")
    given = osp.reconstruct(scene, folder / "given", **OPTIONS, **LIKE_MATERIALS)
    return {
        "given": scene_of(given.path),
        "not": scene_of(osp.reconstruct(scene, folder / "not", **OPTIONS).path),
    }


def scene_of(run: Path) -> bytes:
    return (run / "scene.ply").read_bytes()


def stop_before_training(scene: Path, output: Path, **more: Any) -> dict[str, Any]:
    """Begin a run with materials that stops before it has chosen; return its ``config.json``."""
    asked = {**OPTIONS, "materials": True, **LIKE_MATERIALS, **more}
    stop = patch.object(material_choice, "material_gain_db", side_effect=osp.CancelledError("in a trial"))
    with stop, pytest.raises(osp.CancelledError):
        osp.reconstruct(scene, output, **asked)
    config: dict[str, Any] = json.loads((output / "config.json").read_text())
    assert "material_choice" not in config
    return config


def test_setting_given_as_materials_have_it_stays_without_them(
    scene: Path, plain: dict[str, bytes], tmp_path: Path
) -> None:
    assert plain["given"] != plain["not"]
    by_python = osp.reconstruct(scene, tmp_path / "python", **OPTIONS, materials=True, **LIKE_MATERIALS)
    assert scene_of(by_python.path) == plain["given"]
    assert by_python.settings["train"]["materials"]["learn"] is False
    without = osp.reconstruct(scene, tmp_path / "without", **OPTIONS, materials=True)
    assert scene_of(without.path) == plain["not"]
    sets = [part for assignment in [*FEW, "rays_per_batch=8192"] for part in ("--set", assignment)]
    command = ["reconstruct", str(scene), "-o", str(tmp_path / "command"), "--preset", "fast", "--materials"]
    done = CliRunner().invoke(cli, [*command, "--exports", "", "--threads", "1", *sets])
    assert done.exit_code == 0, done.stderr
    assert scene_of(tmp_path / "command") == plain["given"]
    assert "where none was given;" in " ".join(done.stderr.split())
    config = json.loads((tmp_path / "command" / "config.json").read_text())
    assert config["material_choice"] == "none" and "rays_per_batch" in config["given"]
    # the same command goes on with the finished run
    assert CliRunner().invoke(cli, [*command, "--exports", "", *sets, "--resume"]).exit_code == 0


def test_run_that_goes_on_knows_what_it_was_given(
    scene: Path, plain: dict[str, bytes], tmp_path: Path
) -> None:
    given = stop_before_training(scene, tmp_path / "run")["given"]
    assert {"materials.learn", "rays_per_batch", "test_every"} <= set(given)
    with pytest.raises(osp.ConfigError, match="other settings"):
        osp.reconstruct(scene, tmp_path / "run", **OPTIONS, materials=True, resume=True)
    osp.reconstruct(scene, tmp_path / "run", resume=True, threads=1)
    assert scene_of(tmp_path / "run") == plain["given"]


def test_run_of_a_version_that_did_not_keep_it_goes_on_as_before(
    scene: Path, plain: dict[str, bytes], tmp_path: Path
) -> None:
    config = stop_before_training(scene, tmp_path / "run")
    del config["given"]
    (tmp_path / "run" / "config.json").write_text(json.dumps(config))
    run = osp.reconstruct(scene, tmp_path / "run", **OPTIONS, materials=True, **LIKE_MATERIALS, resume=True)
    assert scene_of(run.path) == plain["not"]
    assert "given" not in json.loads((run.path / "config.json").read_text())
    osp.reconstruct(scene, run, **OPTIONS, materials=True, **LIKE_MATERIALS, resume=True)


@pytest.mark.parametrize("is_written_anew", [False, True])
def test_run_of_a_version_without_a_setting_goes_on_by_the_command_that_began_it(
    scene: Path, tmp_path: Path, is_written_anew: bool
) -> None:
    given = [*FEW, "materials.fallback=false", "materials.environment_height=16"]
    asked = {**OPTIONS, "set": given, "materials": True}
    output = tmp_path / "run"
    with pytest.raises(osp.CancelledError):
        osp.reconstruct(scene, output, **asked, should_stop=lambda: True)
    config = json.loads((output / "config.json").read_text())
    materials = config["reconstruction"]["train"]["materials"]
    assert materials.pop("residual_share") > 0
    if is_written_anew:  # by this version, where it begins the training anew
        materials["residual_share"] = None
    (output / "config.json").write_text(json.dumps(config))
    asked_for = [*given, "materials.residual_share=0.5"]
    with pytest.raises(osp.ConfigError, match="without any option --resume takes those of the run"):
        osp.reconstruct(scene, output, **{**asked, "set": asked_for}, resume=True)
    run = osp.reconstruct(scene, output, **asked, resume=True)
    assert run.is_finished and not (output / "residual.npz").exists()
    assert run.settings["train"]["materials"].get("residual_share") is None


def test_photographs_elsewhere_leave_what_was_given(scene: Path, tmp_path: Path) -> None:
    given = stop_before_training(scene, tmp_path / "run")["given"]
    moved = tmp_path / "moved"
    scene.rename(moved)
    try:
        osp.reconstruct(moved, tmp_path / "run", resume=True, threads=1)
    finally:
        moved.rename(scene)
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["scene"] == str(moved) and config["given"] == given


def test_materials_are_learnt_where_what_was_given_needs_them(scene: Path, tmp_path: Path) -> None:
    options = {**OPTIONS, "set": [*FEW, "ray_patch_rays=1"], "for_surface": True}
    run = osp.reconstruct(scene, tmp_path / "run", **options, materials=True)
    assert run.settings["train"]["materials"]["learn"] is True
