"""Shapes of meshes in a stage: polygons, nodes without extent, normals, and what is passed over."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.files import read_mesh
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.lights import triangle_areas
from octasplat.engine.pathtracing.mesh_shapes import primitive_shape
from octasplat.engine.pathtracing.stage.materials import Diffuse
from octasplat.engine.pathtracing.stage.model import DirectionalLight, Integrator, Stage, StageMesh
from octasplat.engine.render.image_files import write_png
from tests.pathtracing.test_mesh_material import Y_UP, checks, write_glb
from tests.support.light_scenes import camera, film_of

L_SHAPE = ((0, 0), (0, 2), (2, 2), (2, 1), (1, 1), (1, 0))
"""Of the area 3; a fan from most of its corners covers more."""


@pytest.mark.parametrize("start", range(6))
@pytest.mark.parametrize("suffix", [".obj", ".ply"])
def test_concave_polygons_cover_their_own_area_and_no_more(tmp_path: Path, start: int, suffix: str) -> None:
    points = [*L_SHAPE[start:], *L_SHAPE[:start]]
    corners = range(6)
    path = tmp_path / f"l{suffix}"
    if suffix == ".obj":
        lines = [f"v {x} 3 {z}\nvt {x} {z}" for x, z in points] + ["vn 0 1 0"]
        square = "f 2/2/1 1/1/1 3/3/1"
        lines += ["f " + " ".join(f"{k + 1}/{k + 1}/1" for k in corners), square]
        path.write_text("\n".join(lines) + "\n")
    else:
        head = "".join(f"property float {name}\n" for name in "xyzst")
        rows = "\n".join(f"{x} 3 {z} {x} {z}" for x, z in points)
        path.write_text(
            f"ply\nformat ascii 1.0\nelement vertex 6\n{head}element face 1\n"
            f"property list uchar int vertex_indices\nend_header\n{rows}\n6 0 1 2 3 4 5\n"
        )
    mesh = read_mesh(path, with_materials=True)
    found = mesh.vertices[mesh.triangles[:4]].astype(np.float32)
    assert triangle_areas(found).sum() == pytest.approx(3.0)
    across = np.cross(found[:, 1] - found[:, 0], found[:, 2] - found[:, 0])
    assert (across[:, 1] >= 0).all()
    assert mesh.corner_uv is not None
    np.testing.assert_allclose(mesh.corner_uv[:4] * [1, -1] + [0, 1], found[..., [0, 2]])
    if suffix == ".obj":
        assert mesh.triangles[4:].tolist() == [[1, 0, 2]]


def test_damaged_ply_with_texture_coordinates_is_refused_in_a_sentence(tmp_path: Path) -> None:
    head = "".join(f"property float {name}\n" for name in "xyzst")
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 3\n{head}element face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 0 0\n0 1 0 0 0\n3 0 1 7\n"
    )
    with pytest.raises(Exception, match=r"a\.ply: a face names a vertex that is not there"):
        read_mesh(tmp_path / "a.ply", with_materials=True)


def test_images_stand_upright_on_all_sides_of_the_cube() -> None:
    cube = primitive_shape("cube")
    assert cube.corner_uv is not None
    ups = {1: (0, 0, -1), -1: (0, 0, 1)}
    for uv, corners in zip(cube.corner_uv, cube.vertices[cube.faces], strict=True):
        along_u, along_v = np.linalg.solve((uv[1:] - uv[0]).astype(float), corners[1:] - corners[0])
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0]) / 4
        np.testing.assert_allclose(-along_v / 2, ups.get(round(normal[1]), (0, 1, 0)), atol=1e-6)
        # not mirrored, as seen from outside
        np.testing.assert_allclose(np.cross(along_u, -along_v) / 4, normal, atol=1e-6)


def test_glb_nodes_without_extent_are_read(tmp_path: Path) -> None:
    plane = primitive_shape("plane")
    normals = np.broadcast_to(np.array([0.0, 1.0, 0.0]), plane.vertices.shape)
    path = tmp_path / "a.glb"
    for scale, wanted in (([0, 0, 0], None), ([2, 0, 2], [0, 1, 0]), ([-1e-5, 1e-5, 1e-5], [0, 1, 0])):
        more = {"nodes": [{"mesh": 0}, {"mesh": 0, "scale": scale}], "scenes": [{"nodes": [0, 1]}]}
        write_glb(path, plane, [{}], more=more, normals=normals)
        mesh = read_mesh(path, with_materials=True)
        assert len(mesh.triangles) == 4 and mesh.corner_normals is not None
        np.testing.assert_allclose(mesh.corner_normals[:2], np.broadcast_to([0, 1, 0], (2, 3, 3)))
        if wanted is not None:
            np.testing.assert_allclose(mesh.corner_normals[2:], np.broadcast_to(wanted, (2, 3, 3)), atol=1e-6)
    compile_meshes(Stage(meshes=(StageMesh(file="a.glb"),)), tmp_path)


@pytest.mark.parametrize(
    ("coat", "told"),
    [
        ({}, "a clear coat that is smoother than the normal texture"),
        ({"clearcoatNormalTexture": {"index": 0, "scale": 0.5, "texCoord": 0}}, None),
        (
            {"clearcoatNormalTexture": {"index": 0}},
            "clearcoatNormalTexture, a clear coat that is smoother than the normal texture",
        ),
    ],
    ids=["smooth", "same", "other-scale"],
)
def test_normals_of_a_clear_coat_are_told_unless_they_are_those_below(
    tmp_path: Path, coat: dict[str, Any], told: str | None
) -> None:
    material = {
        "name": "m", "normalTexture": {"index": 0, "scale": 0.5},
        "extensions": {"KHR_materials_clearcoat": {"clearcoatFactor": 1, **coat}},
    }  # fmt: skip
    write_glb(tmp_path / "a.glb", primitive_shape("plane"), [material], [checks(tmp_path / "n.png", 0)])
    said: list[str] = []
    compile_meshes(Stage(meshes=(StageMesh(file="a.glb"),)), tmp_path, warn=said.append)
    assert said == ([] if told is None else [f"a.glb: of the material m is not used: {told}."])


@pytest.mark.parametrize(
    ("node", "word"),
    [({"skin": 0}, "bones"), ({"weights": [0, 0.5]}, "morph targets"), ({"weights": [0, 0]}, None),
     ({"extensions": {"EXT_mesh_gpu_instancing": {}}}, "Copies"),
     ({"extensions": {"KHR_lights_punctual": {"light": 0}}}, "lamps")],
)  # fmt: skip
def test_what_glb_nodes_say_in_vain_is_told(tmp_path: Path, node: dict[str, Any], word: str | None) -> None:
    write_glb(tmp_path / "a.glb", primitive_shape("plane"), [{}], node=node)
    said: list[str] = []
    compile_meshes(Stage(meshes=(StageMesh(file="a.glb"),)), tmp_path, warn=said.append)
    if word is None:
        assert said == []
    else:
        assert len(said) == 1 and said[0].startswith("a.glb: ") and word in said[0]


def test_image_that_a_ply_names_is_told_as_passed_over(tmp_path: Path) -> None:
    rows = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    for comments, count in (("comment TextureFile wood bark.png\n", 1), ("comment made by hand\n", 0)):
        (tmp_path / "a.ply").write_text(
            f"ply\nformat ascii 1.0\n{comments}element vertex 3\nproperty float x\nproperty float y\n"
            f"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n{rows}"
        )
        said: list[str] = []
        compile_meshes(Stage(meshes=(StageMesh(file="a.ply"),)), tmp_path, warn=said.append)
        assert len(said) == count
        assert all("wood bark.png is passed over" in sentence for sentence in said)


def test_normal_texture_changes_shading_normal(tmp_path: Path) -> None:
    # x to the right of the image, y up in it; the plane's image has its top towards -z.
    tilt = np.array([0.36, 0.48, 0.8])
    write_png(tmp_path / "tilt.png", np.tile((tilt / 2 + 0.5).astype(np.float32), (2, 2, 1)))
    floor = StageMesh(shape="plane", material=Diffuse(color_srgb=(1, 1, 1), normal_texture="tilt.png"))
    view = camera((0, 3, 1e-3), (0, 0, 0), (3, 3), 1)
    numbers = Integrator(samples=1, max_depth=1, anti_aliasing=False)
    for light in ((0.0, -1.0, 0.0), (-0.6, -0.8, 0.0), (0.0, -0.8, 0.6)):
        sun = DirectionalLight(direction=light, irradiance=np.pi)
        stage = Stage(up=Y_UP, gaussians=(), meshes=(floor,), lights=(sun,), integrator=numbers)
        wanted = -np.dot(light, [tilt[0], tilt[2], -tilt[1]])
        assert film_of(stage, view, tmp_path).image().rgb_linear.mean() == pytest.approx(wanted, abs=0.01)
        # the other side of a bump is a dent
        x, y, z = light
        from_below = stage.model_copy(
            update={"lights": (sun.model_copy(update={"direction": (-x, -y, -z)}),)}
        )
        found = film_of(from_below, camera((0, -3, 1e-3), (0, 0, 0), (3, 3), 1), tmp_path).image().rgb_linear
        assert found.mean() == pytest.approx(wanted, abs=0.01)
