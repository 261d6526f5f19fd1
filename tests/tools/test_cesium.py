"""CesiumJS draws our 3D Tiles where they stand on the Earth; our tracer draws the same scene."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.earth_frame import geocentric_from_metres
from octasplat.engine.core.georeference import WGS84, Georeference, matrix_rows
from octasplat.engine.files import ExportOptions, export_scene, tiles_3d
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from tests.support.browser import open_page, psnr
from tests.support.npm_packages import npm_folder
from tests.support.shell_scene import our_view, shell_scene

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

SIDE_PX, FOV_DEGREES = 256, 40.0
PAGE = """<!doctype html>
<html><head><style>
body { margin: 0; background: #000 }
#view, #view .cesium-widget, #view canvas { width: SIDEpx; height: SIDEpx; display: block }
.cesium-widget-credits { display: none }
</style>
<script>window.CESIUM_BASE_URL = "/node_modules/cesium/Build/Cesium/";</script>
<script src="/node_modules/cesium/Build/Cesium/Cesium.js"></script>
</head><body><div id="view"></div><script>
window.result = (async () => {
  const job = JOB;
  const widget = new Cesium.CesiumWidget("view", {
    baseLayer: false, globe: false, skyBox: false, skyAtmosphere: false, msaaSamples: 1,
    contextOptions: { webgl: { preserveDrawingBuffer: true, antialias: false } },
  });
  widget.scene.backgroundColor = Cesium.Color.BLACK;
  widget.camera.frustum.fov = job.fov_rad;
  widget.camera.frustum.near = 0.05;
  const tileset = await Cesium.Cesium3DTileset.fromUrl("/files/tileset.json");
  const failed = [];
  tileset.tileFailed.addEventListener((event) => failed.push(`${event.url}: ${event.message}`));
  widget.scene.renderError.addEventListener((_, error) => failed.push(String(error)));
  widget.scene.primitives.add(tileset);
  const tiles = [];
  for (const camera of job.cameras) {
    const [destination, direction, up] = camera.map((values) => new Cesium.Cartesian3(...values));
    widget.camera.setView({ destination, orientation: { direction, up } });
    // what is drawn is made aside; it is there when it has as many splats as the tiles that were chosen
    for (let quiet = 0, frame = 0; quiet < 4 && frame < 1000 && failed.length === 0; frame++) {
      await new Promise((done) => requestAnimationFrame(done));
      const splats = tileset.gaussianSplatPrimitive;
      const wanted = tileset._selectedTiles.reduce((sum, tile) => sum + tile.content.pointsLength, 0);
      const is_drawn = tileset.tilesLoaded && splats?.isStable && splats._numSplats === wanted;
      quiet = is_drawn && splats._drawCommand ? quiet + 1 : 0;
    }
    tiles.push(tileset._selectedTiles.map((tile) => tile.content.url.split("/files/")[1]).sort());
  }
  widget.useDefaultRenderLoop = false;
  return { failed, tiles };
})();
</script></body></html>
"""


@pytest.fixture(scope="module")
def cesium() -> Path:
    return npm_folder("cesium", "1.145.0")


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> FlatGaussians:
    """Three levels: 300, 150 and 75 Gaussians, with harmonics of all degrees."""
    monkeypatch.setattr(tiles_3d, "FEWEST_IN_ROOT", 50)
    shell = shell_scene()
    harmonics = np.random.default_rng(1).uniform(-0.3, 0.3, (len(shell), 15, 3)).astype(np.float32)
    return replace(shell, sh=np.concatenate([shell.sh, harmonics], axis=1))


def georeference() -> Georeference:
    """Two metres a unit, turned, in Munich."""
    matrix = np.eye(4)
    matrix[:3, :3] = 2.0 * np.array([[0.8, 0, 0.6], [-0.6, 0, 0.8], [0, -1, 0]])
    matrix[:3, 3] = (30.0, -20.0, 5.0)
    return Georeference(crs=WGS84, anchor=(48.137222, 11.575556, 520.0), matrix=matrix_rows(matrix))


def placed_camera(pose: np.ndarray) -> list[list[float]]:
    """Where a camera of the scene is on the Earth, its direction and what is up in its picture."""
    given = georeference()
    frame = geocentric_from_metres(given)
    assert frame is not None
    matrix = frame @ given.metres_from_scene
    turn = matrix[:3, :3] / given.metres_per_unit
    vectors = [(matrix @ pose[:, 3])[:3], turn @ pose[:3, 2], -turn @ pose[:3, 1]]
    return [values.tolist() for values in vectors]


@pytest.mark.exhaustive
def test_cesium_draws_tiles_on_the_earth_as_our_tracer_does(
    cesium: Path, scene: FlatGaussians, tmp_path: Path
) -> None:
    facts = SceneMetadata(georeference=georeference())
    written = export_scene(scene, tmp_path / "out" / "tileset.json", ExportOptions(facts=facts))
    near, far = np.eye(4), np.eye(4)
    near[:3, 3], far[:3, 3] = (0.2, -0.3, -4.0), (0.2, -0.3, -60.0)
    job = {
        "cameras": [placed_camera(far), placed_camera(near)],
        "fov_rad": float(np.radians(FOV_DEGREES)),
    }
    page = PAGE.replace("JOB", json.dumps(job)).replace("SIDE", str(SIDE_PX))
    files = {path.relative_to(tmp_path / "out").as_posix(): path for path in written}
    shown = open_page(page, packages=cesium, files=files, width=SIDE_PX, height=SIDE_PX)
    assert shown.result["failed"] == [], shown.messages
    assert shown.result["tiles"] == [["tiles/0_0.glb"], [f"tiles/2_{cell}.glb" for cell in range(4)]]
    camera = PinholeCamera.from_pose(near, SIDE_PX, SIDE_PX, fy_px=focal_from_fov(FOV_DEGREES, SIDE_PX))
    ours = to_bytes(our_view(scene, camera))
    assert psnr(shown.image, ours) > 33, shown.messages
    assert psnr(shown.image[:, ::-1], ours) < 27


def test_contents_are_valid_except_unknown_extensions(
    validate_glb: Callable[[Path], dict[str, Any]], scene: FlatGaussians, tmp_path: Path
) -> None:
    for path in export_scene(scene, tmp_path / "out" / "tileset.json")[1:]:
        report = validate_glb(path)
        messages = report["issues"]["messages"]
        bad = {message["code"] for message in messages if message["severity"] <= 1}
        assert bad <= {"MESH_PRIMITIVE_INVALID_ATTRIBUTE", "UNSUPPORTED_EXTENSION"}, messages
        assert report["info"]["totalVertexCount"] == 75
