"""Lit GLBs in other programs, over black: three.js in headless Chromium, and Blender's Cycles."""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.render.image_files import read_image
from octasplat.engine.render.pinhole_camera import PinholeCamera
from tests.support.blender_python import SCRIPTS, run_blender
from tests.support.browser import open_page
from tests.support.npm_packages import npm_folder

THREE = ("three", "0.187.0")
PAGE = """<!doctype html>
<style>html, body { margin: 0; background: #000; } canvas { display: block; }</style>
<script type="importmap">
{ "imports": { "three": "/node_modules/three/build/three.module.js",
               "three/addons/": "/node_modules/three/examples/jsm/" } }
</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { HDRLoader } from "three/addons/loaders/HDRLoader.js";

async function main() {
  const seen = VIEW;
  const gltf = await new GLTFLoader().loadAsync("/files/lit.glb");
  const light = await new HDRLoader().loadAsync("/files/light.hdr");
  light.mapping = THREE.EquirectangularReflectionMapping;
  const scene = new THREE.Scene();
  scene.add(gltf.scene);
  scene.environment = light;
  scene.background = new THREE.Color(0x000000);
  const renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  renderer.setSize(seen.width, seen.height);
  document.body.append(renderer.domElement);
  const near = 0.01, far = 1000, camera = new THREE.PerspectiveCamera();
  const left = (-seen.cx * near) / seen.fx, top = (seen.cy * near) / seen.fy;
  camera.projectionMatrix.makePerspective(
    left, left + (seen.width * near) / seen.fx, top, top - (seen.height * near) / seen.fy,
    near, far, camera.coordinateSystem,
  );
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.updateProjectionMatrix = () => {};
  new THREE.Matrix4().set(...seen.gltf_from_camera.flat())
    .decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  renderer.render(scene, camera);
  return "drawn";
}
window.result = main();
</script>
"""


def view_of(camera: PinholeCamera, light_frame: Float64[np.ndarray, "3 3"]) -> dict[str, object]:
    """A camera where a GLB with materials has it: the light's forward is x, its up y."""
    turn = np.eye(4)
    turn[:3, :3] = light_frame[[2, 1, 0]]
    return {
        "width": camera.width_px,
        "height": camera.height_px,
        "fx": camera.fx_px,
        "fy": camera.fy_px,
        "cx": camera.cx_px,
        "cy": camera.cy_px,
        "gltf_from_camera": (turn @ camera.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
    }


def render_in_threejs(glb: Path, light: Path, view: dict[str, object]) -> Float32[np.ndarray, "h w 3"]:
    """Display values, four samples a pixel."""
    page = open_page(
        PAGE.replace("VIEW", json.dumps(view)),
        packages=npm_folder(*THREE),
        files={"lit.glb": glb, "light.hdr": light},
        width=int(str(view["width"])),
        height=int(str(view["height"])),
        seconds=240.0,
    )
    assert page.result == "drawn", page.messages
    return page.image.astype(np.float32) / np.float32(255)


def render_in_cycles(
    glb: Path, light: Path, view: dict[str, object], samples: int
) -> Float32[np.ndarray, "h w 3"]:
    """Display values."""
    with TemporaryDirectory(prefix="octasplat-lit-") as folder:
        place, out = Path(folder) / "view.json", Path(folder) / "out.png"
        place.write_text(json.dumps(view), encoding="utf-8")
        run_blender(SCRIPTS / "render_lit.py", glb, light, place, out, samples)
        image = read_image(out)
    return image[..., :3] * image[..., 3:]
