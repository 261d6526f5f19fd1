"""The viewer of the web page draws what our tracer sees."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[1] / "tools"))  # the browser, and a scene to draw
from browser import Page, open_page, psnr
from shell_scene import our_view, shell_scene

import service.web
from engine.colour import to_bytes
from engine.gaussians.model import FlatGaussians
from engine.gaussians.octagon import CHI2_2_99, CHI2_3_99
from engine.gaussians.ply import write_gaussian_ply
from engine.render.cameras import RenderCamera, focal_from_fov
from engine.render.renderer import background_colour, render_rays
from engine.trace.cpu import CpuTracer
from engine.trace.protocol import TraceSettings

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service.web.__file__).parent / "static"
SIDE_PX, FOV_DEGREES = 256, 40.0
PAGE = """<!doctype html>
<html><head><style>body { margin: 0; background: #000 } canvas { display: block }</style></head><body>
<canvas width="256" height="256"></canvas>
<script type="module">
import { PerspectiveCamera } from "/files/vendor/three.js";
import { SplatRenderer, Sorting } from "/files/viewer/splats.js";
window.result = (async () => {
  const job = JOB;
  const view = new SplatRenderer(document.querySelector("canvas"));
  view.setSize(job.side, job.side, 1);
  view.setBackground(...job.background);
  const worker = new Worker("/files/viewer/scene_worker.js", { type: "module" });
  const scene = await new Promise((resolve, reject) => {
    worker.onmessage = ({ data }) => {
      if (data.scene) resolve(data.scene);
      else if (data.error) reject(new Error(data.error));
    };
    worker.postMessage({ load: job.url });
  });
  view.setScene(scene, job.q);
  const camera = new PerspectiveCamera(job.fov, 1, 0.01, 100);
  camera.matrixAutoUpdate = false;
  camera.matrix.fromArray(job.pose);
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  const drawn = await new Promise((resolve) => {
    const sorting = new Sorting(worker, scene.count, job.q, (order, count) => {
      view.setOrder(order, count);
      resolve(count);
    });
    sorting.see(camera, 1);
  });
  view.render(camera);
  return { count: scene.count, shCount: scene.shCount, drawn };
})();
</script></body></html>
"""


def camera_at(x: float, y: float, z: float) -> RenderCamera:
    pose = np.eye(4)
    pose[:3, 3] = (x, y, z)
    return RenderCamera.from_pose(pose, SIDE_PX, SIDE_PX, fy_px=focal_from_fov(FOV_DEGREES, SIDE_PX))


def draw(
    scene: FlatGaussians, camera: RenderCamera, folder: Path, *, q: float, background: tuple[float, ...]
) -> Page:
    write_gaussian_ply(scene, folder / "scene.ply")
    # three.js cameras look along -z with y up.
    pose = camera.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
    job = {
        "side": SIDE_PX,
        "fov": FOV_DEGREES,
        "pose": pose.T.reshape(-1).tolist(),
        "url": "/files/scene.ply",
        "q": q,
        "background": background,
    }
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    page = PAGE.replace("JOB", json.dumps(job))
    return open_page(page, files={**files, "scene.ply": folder / "scene.ply"}, width=SIDE_PX, height=SIDE_PX)


def with_harmonics(scene: FlatGaussians, degree: int) -> FlatGaussians:
    random = np.random.default_rng(7)
    sh = random.normal(scale=0.25, size=(len(scene), (degree + 1) ** 2, 3)).astype(np.float32)
    sh[:, 0] = scene.sh[:, 0]
    scene.sh = sh
    return scene


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_draws_what_the_tracer_sees(tmp_path: Path, degree: int) -> None:
    scene = with_harmonics(shell_scene(), degree)
    camera = camera_at(0.2, -0.3, -4.0)
    page = draw(scene, camera, tmp_path, q=CHI2_2_99, background=(0, 0, 0))
    ours = to_bytes(our_view(scene, camera))
    assert page.result == {"count": len(scene), "shCount": (degree + 1) ** 2, "drawn": len(scene)}
    assert (ours.max(axis=2) > 20).mean() > 0.2  # there is something to compare
    quality = psnr(page.image, ours)
    assert quality >= 42.0, page.messages


def test_the_papers_radius_over_white_from_inside(tmp_path: Path) -> None:
    """From within the cloud some Gaussians are behind the camera, and the background counts."""
    scene = with_harmonics(shell_scene(500), 1)
    camera = camera_at(0.1, 0.05, 0.0)
    page = draw(scene, camera, tmp_path, q=CHI2_3_99, background=(1, 1, 1))
    tracer = CpuTracer(TraceSettings(q=CHI2_3_99, transmittance_min=1e-6), threads=1)
    tracer.build(scene)
    ours = to_bytes(render_rays(tracer, camera.rays(), background_colour("white")).rgb_srgb)
    assert page.result["drawn"] < len(scene)
    quality = psnr(page.image, ours)
    assert quality >= 42.0, page.messages
