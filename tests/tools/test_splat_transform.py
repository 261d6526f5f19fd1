"""PlayCanvas splat-transform as judge: what it writes we read as it does, what we write it reads as we do."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files import ExportOptions, export_scene, importer_for, read_scene, streamed_sog
from octasplat.engine.files.gaussian_ply import read_ply_cloud
from octasplat.engine.gaussians.flattening import GaussianCloud
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from tests.support.browser import open_page, psnr
from tests.support.cloud_difference import difference
from tests.support.npm_packages import npm_folder
from tests.support.shell_scene import our_view, shell_scene

pytestmark = pytest.mark.tools
Convert = Callable[..., Path]


@pytest.fixture(scope="module")
def program() -> Path:
    packages = npm_folder("@playcanvas/splat-transform", "2.7.1")
    return packages / "node_modules" / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"


@pytest.fixture(scope="module")
def convert(program: Path) -> Convert:
    """Converts a file with the judge."""

    def run(source: Path, target: Path, *options: str) -> Path:
        node = shutil.which("node")
        assert node is not None
        command = [node, str(program), "-q", "-w", "-g", "cpu", *options, str(source), str(target)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return target

    return run


@pytest.fixture(scope="module")
def scene() -> FlatGaussians:
    random = np.random.default_rng(5)

    def uniform(low: float, high: float, *shape: int) -> np.ndarray:
        return random.uniform(low, high, shape).astype(np.float32)

    return FlatGaussians(
        uniform(-2, 2, 3000, 3),
        random.standard_normal((3000, 4)).astype(np.float32),
        uniform(-5, -2, 3000, 2),
        uniform(-3, 4, 3000),
        np.concatenate([uniform(-1.5, 1.5, 3000, 1, 3), uniform(-0.8, 0.8, 3000, 15, 3)], axis=1),
    )


def read(path: Path) -> GaussianCloud:
    return importer_for(path).read(path)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.compressed.ply", ()),
        ("a.sog", ("--iterations", "2")),
        ("a.spz", ("--spz-version", "3")),
        ("a.spz", ("--spz-version", "4")),
    ],
)
def test_splat_transform_files_are_read_alike(
    convert: Convert, scene: FlatGaussians, tmp_path: Path, name: str, options: tuple[str, ...]
) -> None:
    export_scene(scene, tmp_path / "own.ply")
    theirs = convert(tmp_path / "own.ply", tmp_path / name, *options)
    again = read_ply_cloud(convert(theirs, tmp_path / "again.ply"))
    # They decode SPZ rotations in float32, and opacities of 0 or 1 a little differently.
    difference(read(theirs), again).assert_below(
        position=1e-6, rotation_degrees=0.1, log_scale=1e-6, opacity=0.001, sh=2e-6
    )


@pytest.mark.parametrize(
    ("name", "version", "degrees"),
    [("a.splat", 3, 0.95), ("a.spz", 3, 0.1), ("a.spz", 4, 0.1), ("a.compressed.ply", 3, 0.1)],
)
def test_splat_transform_reads_our_files_alike(
    convert: Convert, scene: FlatGaussians, tmp_path: Path, name: str, version: int, degrees: float
) -> None:
    export_scene(scene, tmp_path / name, ExportOptions(spz_version=version))
    theirs = read_ply_cloud(convert(tmp_path / name, tmp_path / "theirs.ply"))
    # In .splat they take 127.5 for the middle of a byte, and most others 128, as we do.
    difference(read(tmp_path / name), theirs).assert_below(
        position=1e-6, rotation_degrees=degrees, log_scale=1e-6, opacity=0.001, sh=2e-6
    )


def test_splat_transform_reads_our_ply_bit_exactly(
    convert: Convert, scene: FlatGaussians, tmp_path: Path
) -> None:
    export_scene(scene, tmp_path / "own.ply")
    back, report = read_scene(convert(tmp_path / "own.ply", tmp_path / "back.ply"))
    assert report.flattened == 0
    for name in ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scene, name))


def test_splat_transform_glb_is_read(convert: Convert, scene: FlatGaussians, tmp_path: Path) -> None:
    export_scene(scene, tmp_path / "own.ply")
    back, report = read_scene(convert(tmp_path / "own.ply", tmp_path / "theirs.glb"))
    assert (report.count, report.sh_degree, report.flattened) == (3000, 3, 0)
    # It turns a PLY by half a turn about z and calls that y up: seen from us, half a turn about y.
    np.testing.assert_allclose(back.means_world, scene.means_world * (-1, 1, -1), atol=1e-6)
    np.testing.assert_allclose(back.log_scales, scene.log_scales, atol=2e-6)
    np.testing.assert_allclose(back.opacities, scene.opacities, atol=1e-6)
    normals = scene.rotations[:, :, 0] * (-1, 1, -1)
    np.testing.assert_allclose(np.abs(np.sum(back.rotations[:, :, 0] * normals, axis=1)), 1, atol=1e-5)


@pytest.mark.exhaustive
def test_sog_is_written_through_it(
    program: Path, scene: FlatGaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OCTASPLAT_SPLAT_TRANSFORM", os.fspath(program))
    written = export_scene(scene, tmp_path / "out" / "a.sog")
    assert list((tmp_path / "out").iterdir()) == list(written)
    back, report = read_scene(written[0])
    assert (report.count, report.sh_degree) == (3000, 3)
    # It sorts the Gaussians; the nearest of ours in place is the same one.
    distances = np.linalg.norm(back.means_world[:, None] - scene.means_world[None], axis=2)
    ours = distances.argmin(axis=1)
    assert len(np.unique(ours)) == 3000
    assert distances.min(axis=1).max() < 2e-4
    np.testing.assert_allclose(back.log_scales, scene.log_scales[ours], atol=0.1)
    np.testing.assert_allclose(back.opacities, scene.opacities[ours], atol=1.002 / 255)  # rounded down
    np.testing.assert_allclose(back.base_rgb_srgb, scene.base_rgb_srgb[ours], atol=0.01)
    normals = np.abs(np.sum(back.rotations[:, :, 0] * scene.rotations[ours][:, :, 0], axis=1))
    assert np.degrees(np.arccos(np.clip(normals, -1, 1))).max() < 1.8  # components rounded down too


@pytest.mark.exhaustive
def test_levels_of_detail_are_written_through_it(
    program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OCTASPLAT_SPLAT_TRANSFORM", os.fspath(program))
    monkeypatch.setattr(streamed_sog, "MIN_LEVEL_COUNT", 50)
    scene = shell_scene()
    index, *chunks = export_scene(scene, tmp_path / "out" / "lod-meta.json")
    meta = json.loads(index.read_text())
    counts = [len(scene) >> k for k in range(meta["lodLevels"])]
    assert meta["counts"] == counts == [300, 150, 75]
    assert {path.relative_to(index.parent).as_posix() for path in chunks} >= set(meta["filenames"])
    assert sorted(path.name for path in index.parent.iterdir() if path.is_dir()) == sorted(
        {name.split("/")[0] for name in meta["filenames"]}
    )
    levels: dict[str, list[GaussianCloud]] = {}
    for name in meta["filenames"]:
        levels.setdefault(name.split("_")[0], []).append(read(index.parent / name))
    found = [sum(len(cloud.means_world) for cloud in levels[str(k)]) for k in range(len(counts))]
    assert found == counts
    means = np.concatenate([cloud.means_world for cloud in levels["0"]])
    nearest = np.linalg.norm(means[:, None] - scene.means_world[None], axis=2)
    assert nearest.min(axis=0).max() < 1e-3 and len(np.unique(nearest.argmin(axis=0))) == len(scene)
    low, high = (np.array(meta["tree"]["bound"][side]) for side in ("min", "max"))
    assert (low <= scene.means_world.min(axis=0)).all() and (high >= scene.means_world.max(axis=0)).all()
    again = export_scene(scene.select(slice(0, 90)), index)  # fewer levels: nothing of before is left
    assert json.loads(index.read_text())["counts"] == [90] and set(again) < {index, *chunks}
    assert sorted(path.name for path in index.parent.iterdir()) == ["0_0", "lod-meta.json"]
    (tmp_path / "out" / "0_0" / "mine.txt").write_text("kept")
    with pytest.raises(SceneFileError, match="0_0 is there already and no part of it"):
        export_scene(scene, index)
    assert (tmp_path / "out" / "0_0" / "mine.txt").exists() and json.loads(index.read_text())["counts"] == [
        90
    ]
    (tmp_path / "out" / "0_0" / "mine.txt").unlink()
    shutil.move(index, tmp_path / "out" / "other.json")
    with pytest.raises(SceneFileError, match="0_0 is there already and no part of it"):
        export_scene(scene, index)
    assert (tmp_path / "out" / "0_0" / "meta.json").exists() and not index.exists()


PLAYCANVAS_PAGE = """<!doctype html>
<html><head><style>body { margin: 0; background: #000 } canvas { display: block }</style>
<script type="importmap">{"imports": {"playcanvas": "/node_modules/playcanvas/build/playcanvas.mjs"}}</script>
</head><body><canvas id="canvas" width="256" height="256"></canvas><script type="module">
import * as pc from "playcanvas";
window.result = (async () => {
  const graphicsDeviceOptions = { antialias: false, preserveDrawingBuffer: true };
  const app = new pc.Application(document.getElementById("canvas"), { graphicsDeviceOptions });
  app.start();
  app.setCanvasResolution(pc.RESOLUTION_FIXED, 256, 256);
  const camera = new pc.Entity();
  const clearColor = new pc.Color(0, 0, 0);
  camera.addComponent("camera", { clearColor, fov: FOV, nearClip: 0.01, farClip: 100 });
  camera.setPosition(...POSITION);
  camera.setEulerAngles(0, 180, 180); // looks along +z with y down
  app.root.addChild(camera);
  const asset = new pc.Asset("scene", "gsplat", { url: "/files/lod-meta.json", filename: "lod-meta.json" });
  app.assets.add(asset);
  await new Promise((done, fail) => { asset.ready(done); asset.on("error", fail); app.assets.load(asset); });
  const scene = new pc.Entity();
  scene.addComponent("gsplat", { asset, unified: true });
  app.root.addChild(scene);
  const frames = [];
  for (let k = 0; k < 40; k++) {
    await new Promise((done) => setTimeout(done, 100));
    app.renderNextFrame = true;
    frames.push(app.stats.frame.gsplats ?? 0);
  }
  return frames;
})();
</script></body></html>
"""


@pytest.mark.exhaustive
def test_playcanvas_shows_levels_of_detail(
    program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OCTASPLAT_SPLAT_TRANSFORM", os.fspath(program))
    monkeypatch.setattr(streamed_sog, "MIN_LEVEL_COUNT", 50)
    scene = shell_scene()
    written = export_scene(scene, tmp_path / "out" / "lod-meta.json")
    pose = np.eye(4)
    pose[:3, 3] = (0.2, -0.3, -4.0)
    camera = PinholeCamera.from_pose(pose, 256, 256, fy_px=focal_from_fov(40.0, 256))
    page = PLAYCANVAS_PAGE.replace("FOV", "40").replace("POSITION", "[0.2, -0.3, -4]")
    files = {path.relative_to(tmp_path / "out").as_posix(): path for path in written}
    shown = open_page(page, packages=program.parents[4], files=files)
    ours = to_bytes(our_view(scene, camera))
    assert psnr(shown.image, ours) > 30, (shown.result, shown.messages)
