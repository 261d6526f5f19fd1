"""Spark, a splat viewer on three.js, draws our files; our tracer draws the same scene."""

import json
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.color import to_bytes
from octasplat.engine.files import export_scene
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from tests.support.browser import Page, open_page, psnr
from tests.support.npm_packages import npm_folder
from tests.support.shell_scene import our_view, shell_scene

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

SIDE_PX, FOV_DEGREES = 256, 40.0
PAGE = """<!doctype html>
<html><head><style>body { margin: 0; background: #000 } canvas { display: block }</style>
<script type="importmap">{"imports": {
  "three": "/node_modules/three/build/three.module.js",
  "three/addons/": "/node_modules/three/examples/jsm/",
  "@sparkjsdev/spark": "/node_modules/@sparkjsdev/spark/dist/spark.module.js"}}</script></head><body>
<script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
window.result = (async () => {
  const job = JOB;
  const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
  renderer.setPixelRatio(1);
  renderer.setSize(job.side, job.side);
  document.body.appendChild(renderer.domElement);
  const scene = new THREE.Scene();
  scene.add(new SparkRenderer({ renderer, ...job.settings }));
  const camera = new THREE.PerspectiveCamera(job.fov, 1, 0.01, 100);
  camera.matrixAutoUpdate = false;
  camera.matrix.fromArray(job.pose);
  camera.updateMatrixWorld(true);
  const mesh = new SplatMesh({ url: job.url });
  mesh.rotation.x = job.turn;
  scene.add(mesh);
  await mesh.initialized;
  for (let frame = 0; frame < 12; frame++) {  // sorting runs beside drawing
    renderer.render(scene, camera);
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
  return mesh.packedSplats?.numSplats ?? mesh.numSplats;
})();
</script></body></html>
"""
EXACT = {"maxStdDev": 3.0348, "blurAmount": 0.0, "preBlurAmount": 0.0, "minAlpha": 0.0}
"""Splats drawn as far out as ours and not widened for the pixel grid."""


@pytest.fixture(scope="module")
def spark() -> Path:
    return npm_folder("@sparkjsdev/spark", "2.2.0", "three@0.180.0")


@pytest.fixture(scope="module")
def camera() -> PinholeCamera:
    pose = np.eye(4)
    pose[:3, 3] = (0.2, -0.3, -4.0)
    return PinholeCamera.from_pose(pose, SIDE_PX, SIDE_PX, fy_px=focal_from_fov(FOV_DEGREES, SIDE_PX))


def draw(
    spark: Path, file: Path, camera: PinholeCamera, settings: dict[str, float], turn: float = 0.0
) -> Page:
    """The file in Spark; ``turn`` about x, radians, is for files with y up."""
    # three.js cameras look along -z with y up.
    pose = camera.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
    job = {
        "side": SIDE_PX,
        "fov": FOV_DEGREES,
        "pose": pose.T.reshape(-1).tolist(),
        "url": f"/files/{file.name}",
        "settings": settings,
        "turn": turn,
    }
    page = PAGE.replace("JOB", json.dumps(job))
    return open_page(page, packages=spark, files={file.name: file}, width=SIDE_PX, height=SIDE_PX)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "turn", "settings", "least_db"),
    [
        ("scene.ply", 0.0, EXACT, 41.0),
        ("scene.ply", 0.0, {}, 38.0),
        ("scene.splat", 0.0, EXACT, 41.0),
        ("scene.spz", np.pi, EXACT, 40.0),
    ],
)
def test_spark_render_equals_tracer(
    spark: Path,
    camera: PinholeCamera,
    tmp_path: Path,
    name: str,
    turn: float,
    settings: dict[str, float],
    least_db: float,
) -> None:
    scene = shell_scene()
    export_scene(scene, tmp_path / name)
    page = draw(spark, tmp_path / name, camera, settings, turn)
    ours = to_bytes(our_view(scene, camera))
    assert ours.max() > 150 and (ours.max(axis=2) > 20).mean() > 0.2  # there is something to compare
    assert page.result == len(scene)
    assert psnr(page.image, ours) >= least_db, page.messages
