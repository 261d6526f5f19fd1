"""The viewer of the web page draws what our tracer sees."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octasplat.service.web as service_web
from octasplat.engine.core.color import to_bytes
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import CHI2_2_99, CHI2_3_99
from octasplat.engine.pathtracing.environment import EnvironmentMap, environment_frame
from octasplat.engine.pathtracing.relighting.split_sum_relighter import SplitSumRelighter
from octasplat.engine.render.environment_files import read_environment, write_environment
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.renderer import background_color, render_rays
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.browser import Page, open_page, psnr
from tests.support.daily import some_daily
from tests.support.light_scenes import shiny_ball
from tests.support.shell_scene import our_view, shell_scene

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
SIDE_PX, FOV_DEGREES = 256, 40.0
PAGE = """<!doctype html>
<html><head><style>body { margin: 0; background: #000 } canvas { display: block }</style></head><body>
<canvas width="256" height="256"></canvas>
<script type="module">
import { PerspectiveCamera } from "/files/vendor/three.js";
import { readHdr } from "/files/viewer/environment.js";
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
  await view.setScene(scene, job.q);
  if (job.light) {
    view.setLight(readHdr(await (await fetch("/files/light.hdr")).arrayBuffer()));
    view.lighting.turn(job.light.up, job.light.degrees);
    await view.setScene(scene, job.q); // as where the device's graphics were gone: it keeps the light
  }
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


def camera_at(x: float, y: float, z: float) -> PinholeCamera:
    pose = np.eye(4)
    pose[:3, 3] = (x, y, z)
    return PinholeCamera.from_pose(pose, SIDE_PX, SIDE_PX, fy_px=focal_from_fov(FOV_DEGREES, SIDE_PX))


def draw(
    scene: FlatGaussians,
    camera: PinholeCamera,
    folder: Path,
    *,
    q: float,
    background: tuple[float, ...],
    light: dict[str, Any] | None = None,
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
        "light": light,
    }
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    page = PAGE.replace("JOB", json.dumps(job))
    files |= {path.name: path for path in (folder / "scene.ply", folder / "light.hdr") if path.exists()}
    return open_page(page, files=files, width=SIDE_PX, height=SIDE_PX)


def with_harmonics(scene: FlatGaussians, degree: int) -> FlatGaussians:
    random = np.random.default_rng(7)
    sh = random.normal(scale=0.25, size=(len(scene), (degree + 1) ** 2, 3)).astype(np.float32)
    sh[:, 0] = scene.sh[:, 0]
    scene.sh = sh
    return scene


@pytest.mark.parametrize("degree", some_daily([0, 1, 2, 3], {0, 3}))
def test_viewer_draws_traced_image(tmp_path: Path, degree: int) -> None:
    scene = with_harmonics(shell_scene(), degree)
    camera = camera_at(0.2, -0.3, -4.0)
    page = draw(scene, camera, tmp_path, q=CHI2_2_99, background=(0, 0, 0))
    ours = to_bytes(our_view(scene, camera))
    assert page.result == {"count": len(scene), "shCount": (degree + 1) ** 2, "drawn": len(scene)}
    assert (ours.max(axis=2) > 20).mean() > 0.2  # there is something to compare
    quality = psnr(page.image, ours)
    assert quality >= 42.0, page.messages


def test_viewer_with_paper_radius_over_white(tmp_path: Path) -> None:
    """From within the cloud some Gaussians are behind the camera, and the background counts."""
    scene = with_harmonics(shell_scene(500), 1)
    camera = camera_at(0.1, 0.05, 0.0)
    page = draw(scene, camera, tmp_path, q=CHI2_3_99, background=(1, 1, 1))
    tracer = CpuTracer(TraceSettings(q=CHI2_3_99, transmittance_min=1e-6), threads=1)
    tracer.build(scene)
    ours = to_bytes(render_rays(tracer, camera.rays(), background_color("white")).rgb_srgb)
    assert page.result["drawn"] < len(scene)
    quality = psnr(page.image, ours)
    assert quality >= 42.0, page.messages


@pytest.mark.parametrize(
    ("metallic", "roughness", "degrees", "least"),
    some_daily([(1.0, 0.1, 0, 25.0), (1.0, 0.4, 90, 38.0), (0.0, 0.8, -30, 45.0)], {(1.0, 0.4, 90, 38.0)}),
)
def test_draws_materials_in_the_light_of_a_map(
    tmp_path: Path, metallic: float, roughness: float, degrees: int, least: float
) -> None:
    """A ball, about as ``relight`` shows it.

    Its map has 256 rows and the viewer's 128, which tells where edges of light are mirrored; and facets of
    rough metal see the ball itself near its outline, for which the viewer does not look.
    """
    scene = shiny_ball(2000, 1.0, albedo=(0.9, 0.5, 0.2), metallic=metallic, roughness=roughness)
    random = np.random.default_rng(3)
    light = np.kron(random.uniform(0, 1, (4, 8, 3)) ** 3, np.ones((8, 8, 1))).astype(np.float32)
    write_environment(tmp_path / "light.hdr", light)
    camera = camera_at(0.3, -0.4, -4.0)
    up = (0.0, -1.0, 0.0)
    asked = {"up": up, "degrees": degrees}
    page = draw(scene, camera, tmp_path, q=CHI2_2_99, background=(0, 0, 0), light=asked)
    relighter = SplitSumRelighter(
        scene, TraceSettings(), None, extent_world=40.0, rays_across_pixel=1, threads=1
    )
    relighter.set_environment(
        EnvironmentMap(read_environment(tmp_path / "light.hdr"), environment_frame(np.array(up), degrees))
    )
    ours = to_bytes(np.clip(relighter.render(camera.rays()).composite_over(background_color("black")), 0, 1))
    assert (ours.max(axis=2) > 20).mean() > 0.1
    quality = psnr(page.image, ours)
    assert quality >= least, page.messages
