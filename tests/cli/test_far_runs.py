"""A run of a scene with large coordinates is relit, measured and exported as its twin at the origin."""

import json
import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.dataset.views_file import read_views
from octasplat.engine.files import read_metadata
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.image_files import read_image
from octasplat.engine.runs.viewer_glb import upright_turn
from tests.support.tiny_dataset import make_tiny_dataset

ORIGIN = (500_000.0, 5_400_000.0, 250.0)


def moved_far(scene: Path, folder: Path) -> Path:
    """Copy photographs into a folder, with a model in map coordinates."""
    root = folder / scene.name
    shutil.copytree(scene, root)
    model = pycolmap.Reconstruction(str(root / "sparse/0"))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(ORIGIN)))
    model.write_binary(str(root / "sparse/0"))
    return root


@pytest.fixture(scope="module")
def far_scene(run, tmp_path_factory) -> Path:
    """The photographs of the run with a model in map coordinates."""
    return moved_far(run.scene, tmp_path_factory.mktemp("far"))


@pytest.fixture(scope="module")
def others(tmp_path_factory) -> tuple[Path, Path]:
    """Few and small photographs of the same things, and the same far away."""
    near = make_tiny_dataset(tmp_path_factory, views=3, width_px=24, height_px=18)
    return near, moved_far(near, tmp_path_factory.mktemp("far_others"))


@pytest.fixture
def runs(shiny_run, far_scene, tmp_path) -> tuple[Path, Path]:
    """The run with materials, and its twin about a local origin."""
    near, far = (shutil.copytree(shiny_run, tmp_path / name / "run") for name in ("near", "far"))
    gaussians, _ = read_gaussian_ply(far / "scene.ply")
    write_gaussian_ply(gaussians, far / "scene.ply", facts=replace(read_metadata(far), origin_world=ORIGIN))
    for name, change in (
        ("views.json", {"origin_world": ORIGIN}),
        ("config.json", {"scene": str(far_scene)}),
    ):
        content = json.loads((far / name).read_text())
        (far / name).write_text(json.dumps(content | change))
    return near, far


def call(octasplat, *arguments: object) -> str:
    result = octasplat(*arguments)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.exhaustive
@pytest.mark.parametrize("integrator", ["split-sum", "path"])
def test_far_run_is_relit_as_at_the_origin(octasplat, runs, others, tmp_path, integrator):
    light = np.linspace(0.1, 3.0, 16 * 32 * 3, dtype=np.float32).reshape(16, 32, 3)
    write_environment(tmp_path / "day.hdr", light)
    options = ("--environment", tmp_path / "day.hdr", "--integrator", integrator, "--samples", 4)
    for folder, scene, origin in zip(runs, others, ((0.0, 0.0, 0.0), ORIGIN), strict=True):
        call(octasplat, "relight", folder, *options, "-o", folder.parent / "held_out")
        call(octasplat, "relight", folder, *options, "--other-dataset", scene, "-o", folder.parent / "others")
        centre = np.add(origin, (0.5, -1.0, -4.0)).tolist()
        camera = ("--camera", *centre, "--look-at", *origin, "--width", 32, "--height", 24)
        call(octasplat, "relight", folder, *options, *camera, "-o", folder.parent / "one.png")
    near, far = (sorted(folder.parent.rglob("*.png")) for folder in runs)
    near, far = ([path for path in paths if "run" not in path.parts] for paths in (near, far))
    assert len(near) == len(far) > 2 + 1
    for one, other in zip(near, far, strict=True):
        assert one.relative_to(runs[0].parent) == other.relative_to(runs[1].parent)
        np.testing.assert_allclose(read_image(other), read_image(one), atol=2)
    assert any(np.ptp(read_image(path)) > 0 for path in near)


@pytest.mark.exhaustive
def test_far_run_is_measured_as_at_the_origin(octasplat, runs, others):
    found = []
    for folder, scene in zip(runs, others, strict=True):
        call(octasplat, "evaluate", folder)
        call(octasplat, "evaluate", folder, "--scales", "2")
        call(octasplat, "evaluate", folder, "--other-dataset", scene)
        names = ("metrics.json", f"on/{scene.name}/metrics.json")
        psnr = [json.loads((folder / name).read_text())["mean"]["psnr"] for name in names]
        found.append([*psnr, json.loads((folder / "scales.json").read_text())["1/2"]["1"]])
    np.testing.assert_allclose(found[1], found[0], atol=1e-3)
    assert found[0][0] > 5


@pytest.mark.exhaustive
def test_other_photographs_at_the_origin_do_not_belong_to_a_far_run(octasplat, runs, run):
    result = octasplat("evaluate", runs[1], "--other-dataset", run.scene)
    assert result.exit_code == 1 and "world" in result.stderr


def test_viewer_file_of_a_far_run_is_that_at_the_origin(octasplat, runs):
    near, far = runs
    assert upright_turn(far) == pytest.approx(upright_turn(near))
    parts = []
    for folder in runs:
        file = folder.parent / "viewer.glb"
        call(octasplat, "export", folder, file)
        parts.append(glb_parts(file))
    np.testing.assert_allclose(read_metadata(far.parent / "viewer.glb").origin_world, ORIGIN, atol=1e-6)
    assert parts[0][1] == parts[1][1]
    assert parts[0][0].keys() == parts[1][0].keys()
    different = {key for key in parts[0][0] if parts[0][0][key] != parts[1][0][key]}
    assert different == {"nodes"}


def glb_parts(file: Path) -> tuple[dict, bytes]:
    """Return the JSON and the binary part of a GLB."""
    data = file.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


@pytest.mark.parametrize("shift", [(1000.0, 0.0, -20.0), tuple(-x for x in ORIGIN)])
def test_cameras_of_a_far_run_go_along_with_its_scene(octasplat, runs, tmp_path, shift):
    """Views and Gaussians of a moved run are about one local origin, and stand where the shift puts them."""
    _, far = runs
    call(octasplat, "transform", far, "--translate", *shift, "-o", tmp_path / "moved")

    def places(folder: Path) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
        record, gaussians = read_views(folder / "views.json"), read_gaussian_ply(folder / "scene.ply")[0]
        origin = read_metadata(folder).origin_world
        cameras = np.stack([view.origin_world for view in record.viewpoints(None).views])
        return cameras + record.origin_world, gaussians.means_world.astype(float) + origin, origin

    before, after = places(far), places(tmp_path / "moved")
    assert read_views(tmp_path / "moved" / "views.json").origin_world == after[2] != before[2]
    for one, other in zip(before[:2], after[:2], strict=True):
        np.testing.assert_allclose(other, one + shift, atol=1e-3)
