"""The viewer of meshes on the web page shows the mesh of a GLB file in its colors."""

import json
from pathlib import Path

import numpy as np
import pytest

import octasplat.service.web as service_web
from octasplat.engine.files.glb_surface import write_surface
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from tests.support.browser import Page, open_page

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

STATIC = Path(service_web.__file__).parent / "static"
SIDE_PX = 128
PAGE = """<!doctype html>
<html><head><style>body { margin: 0 } canvas { display: block }</style></head><body>
<canvas width="128" height="128"></canvas>
<script type="module">
import { PerspectiveCamera, Vector3 } from "/files/vendor/three.js";
import { MeshRenderer } from "/files/viewer/meshes.js";
window.result = (async () => {
  const view = new MeshRenderer(document.querySelector("canvas"));
  view.setSize(SIDE, SIDE, 1);
  view.setBackground(0, 0, 0);
  const { center, radius, triangles } = await view.load("/files/mesh.glb");
  const camera = new PerspectiveCamera(40, 1, 0.01, 100);
  camera.position.set(...EYE);
  camera.lookAt(center);
  view.render(camera, center);
  return { center: center.toArray(), radius, triangles };
})();
</script></body></html>
"""


def square(rgb: tuple[float, float, float] | None = None, textured: bool = False) -> TriangleMesh:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    texture = None
    if textured:
        texture = np.zeros((16, 16, 3), np.uint8)
        texture[:, :8], texture[:, 8:] = (255, 0, 0), (0, 0, 255)
    return TriangleMesh(
        corners,
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        None if rgb is None else np.tile(np.array(rgb, np.float32), (4, 1)),
        uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32) if textured else None,
        texture_srgb=texture,
    )


def draw(mesh: TriangleMesh, folder: Path, eye: tuple[float, float, float]) -> Page:
    write_surface(mesh, folder / "mesh.glb")
    files = {path.relative_to(STATIC).as_posix(): path for path in STATIC.rglob("*.js")}
    page = PAGE.replace("SIDE", str(SIDE_PX)).replace("EYE", json.dumps(eye))
    return open_page(page, files=files | {"mesh.glb": folder / "mesh.glb"}, width=SIDE_PX, height=SIDE_PX)


def test_mesh_with_colors_of_vertices_is_shown_in_them(tmp_path: Path) -> None:
    page = draw(square((0.1, 0.8, 0.1)), tmp_path, (0, 0, 4))
    assert page.result["triangles"] == 2, page.messages
    assert page.result["center"] == pytest.approx([0, 0, 0])
    assert page.result["radius"] == pytest.approx(np.sqrt(2))
    red, green, blue = page.image[SIDE_PX // 2, SIDE_PX // 2].astype(int)
    assert green > 100 and green > 2 * max(red, blue)
    assert page.image[2, 2].max() == 0  # the square does not reach the corner


def test_texture_is_shown_the_right_way_round(tmp_path: Path) -> None:
    page = draw(square(textured=True), tmp_path, (0, 0, 4))
    left, right = (page.image[SIDE_PX // 2, x].astype(int) for x in (SIDE_PX // 2 - 16, SIDE_PX // 2 + 16))
    assert left[0] > 100 and left[0] > 2 * left[2], page.messages
    assert right[2] > 100 and right[2] > 2 * right[0], page.messages
