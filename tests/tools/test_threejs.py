"""three.js draws our GLB as its example page asks, in headless Chromium."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.color import to_bytes
from octasplat.engine.files import ExportOptions, export_scene
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from tests.support.browser import psnr
from tests.support.daily import some_daily
from tests.support.shell_scene import our_view, shell_cameras, shell_scene, write_shell_cameras
from tests.support.threejs_example import draw_glb

pytestmark = [pytest.mark.tools, pytest.mark.heavy]


@pytest.fixture(scope="module")
def scene() -> FlatGaussians:
    return shell_scene(1000)


@pytest.fixture(scope="module")
def cameras(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cameras") / "cameras.json"
    write_shell_cameras(path)
    return path


@pytest.mark.parametrize(("sort", "least_db"), [(True, 45.0), (False, 42.0)])
@pytest.mark.parametrize("frame", some_daily([0, 1], [1]))
def test_threejs_render_equals_tracer(
    scene: FlatGaussians, cameras: Path, tmp_path: Path, frame: int, sort: bool, least_db: float
) -> None:
    export_scene(scene, tmp_path / "scene.glb", ExportOptions(chunks=2))
    page = draw_glb(tmp_path / "scene.glb", cameras, frame, sort=sort)
    ours = to_bytes(our_view(scene, shell_cameras()[frame]))
    assert (ours.max(axis=2) > 20).mean() > 0.2  # there is something to compare
    assert psnr(page.image, ours) >= least_db, page.messages


@pytest.mark.exhaustive
def test_averaged_frames_have_the_right_order_where_octagons_cross(cameras: Path, tmp_path: Path) -> None:
    # Two large octagons through each other: half of each lies before the other, whichever is drawn last.
    scene = FlatGaussians(
        np.zeros((2, 3), np.float32),
        np.array([[np.cos(a), 0, np.sin(a), 0] for a in (np.pi / 8, 3 * np.pi / 8)], np.float32),
        np.full((2, 2), np.log(0.3), np.float32),
        np.full(2, 3.0, np.float32),
        np.array([[[1.0, -1.0, -1.0]], [[-1.0, 1.0, -1.0]]], np.float32),
    )
    export_scene(scene, tmp_path / "scene.glb")
    ours = to_bytes(our_view(scene, shell_cameras()[0]))
    sorted_db = psnr(draw_glb(tmp_path / "scene.glb", cameras, 0).image, ours)
    refined_db = psnr(draw_glb(tmp_path / "scene.glb", cameras, 0, refine=256).image, ours)
    assert sorted_db < 30.0
    assert refined_db > 37.0


@pytest.mark.exhaustive
def test_threejs_more_chunks_reduce_error(cameras: Path, tmp_path: Path) -> None:
    scene = shell_scene(20000)
    ours = to_bytes(our_view(scene, shell_cameras()[0]))
    figures = []
    for chunks in (1, 64):
        export_scene(scene, tmp_path / "scene.glb", ExportOptions(chunks=chunks))
        figures.append(psnr(draw_glb(tmp_path / "scene.glb", cameras, 0, sort=False).image, ours))
    assert figures[1] > figures[0] + 0.3


@pytest.mark.exhaustive
def test_threejs_opaque_variant_is_order_independent(
    scene: FlatGaussians, cameras: Path, tmp_path: Path
) -> None:
    backwards = scene.select(np.arange(len(scene))[::-1])
    images = []
    for number, version in enumerate((scene, backwards)):
        export_scene(version, tmp_path / f"{number}.glb", ExportOptions(opaque=True, chunks=1))
        images.append(draw_glb(tmp_path / f"{number}.glb", cameras, 0, sort=False).image)
    assert (images[0].max(axis=2) > 20).mean() > 0.1
    np.testing.assert_array_equal(images[0], images[1])


@pytest.mark.exhaustive
def test_threejs_opaque_cores_hide_background_in_any_order(cameras: Path, tmp_path: Path) -> None:
    # Two opaque discs that face the camera, the near one first, so that the far one is blended over it.
    camera = shell_cameras()[0]
    towards = camera.centre_world / np.linalg.norm(camera.centre_world)
    scene = FlatGaussians(
        np.stack([0.3 * towards, -0.3 * towards]).astype(np.float32),
        quaternions_from_matrices(frames_from_normals(np.tile(towards, (2, 1)))).astype(np.float32),
        np.log(np.array([[0.15, 0.15], [0.3, 0.3]], np.float32)),
        np.full(2, 7.0, np.float32),
        np.array([[[1.5, -1.5, -1.5]], [[-1.5, -1.5, 1.5]]], np.float32),
    )
    ours = to_bytes(our_view(scene, camera))
    middle = (101, 120)  # what the camera looks at
    shown = []
    for cores in (None, 0.3):
        export_scene(scene, tmp_path / "scene.glb", ExportOptions(chunks=1, cores=cores))
        shown.append(draw_glb(tmp_path / "scene.glb", cameras, 0, sort=False).image)
    red, blue = ours[middle][0], ours[middle][2]
    assert red > 200 > 40 > blue
    # Without cores the far disc lies before the near one.
    assert shown[0][middle][2] > 200 > 40 > shown[0][middle][0]
    assert np.abs(shown[1][middle].astype(int) - ours[middle]).max() <= 3
