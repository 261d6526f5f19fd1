"""What an OBJ and its MTL files say of a mesh's looks: libraries, glass and normals."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.mesh_shapes import primitive_shape
from octasplat.engine.pathtracing.stage.model import Stage, StageMesh
from tests.pathtracing.test_mesh_material import welded, write_obj


def test_obj_several_libraries_in_a_line_are_read_the_first_before_the_others(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "my b.mtl").write_text("newmtl red\nKd 0 0 1\nnewmtl green\nKd 0 1 0\n")
    for line in ("a.mtl my b.mtl", "a.mtl  lost.mtl my b.mtl", "a.mtl\nmtllib my b.mtl"):
        for name, color in (("red", [1, 0, 0]), ("green", [0, 1, 0])):
            write_obj(tmp_path / "a.obj", primitive_shape("plane"), f"mtllib {line}\nusemtl {name}")
            said: list[str] = []
            found = compile_meshes(Stage(meshes=(StageMesh(file="a.obj"),)), tmp_path, warn=said.append)
            assert said == []
            np.testing.assert_allclose(found.materials.colors_linear, [color], atol=1e-6)
    write_obj(tmp_path / "a.obj", primitive_shape("plane"), "mtllib a.mtl c.mtl\nusemtl green")
    compile_meshes(Stage(meshes=(StageMesh(file="a.obj"),)), tmp_path, warn=said.append)
    assert said == [
        "a.obj: of the material green is not used: its entry, as c.mtl is not in the folder of the OBJ."
    ]


@pytest.mark.parametrize(
    ("keys", "tint"),
    [
        ("Kd 0.01 0.01 0.01\nTf 0.9 0.5 1", (0.9, 0.5, 1)),
        ("Kd 0.2 0.6 0.1", (0.2, 0.6, 0.1)),
        ("Kd 0.2 0.6 0.1\nTf 0 0 0", (0.2, 0.6, 0.1)),
        ("Kd 0.2 0.6 0.1\nPr 0\nPm 0\nTf 1 1 1", (0.2, 0.6, 0.1)),
    ],
)
def test_obj_glass_has_the_color_of_its_transmission_filter(
    tmp_path: Path, keys: str, tint: tuple[float, ...]
) -> None:
    (tmp_path / "a.mtl").write_text(f"newmtl glass\nNi 1.5\nillum 7\n{keys}\n")
    write_obj(tmp_path / "a.obj", welded(primitive_shape("cube")), "mtllib a.mtl\nusemtl glass")
    found = compile_meshes(Stage(meshes=(StageMesh(file="a.obj"),)), tmp_path).materials
    np.testing.assert_allclose(found.colors_linear, [tint], atol=1e-6)


@pytest.mark.parametrize("corner", ["{0}//{1}", "{0}/1/{1}"])
def test_obj_normals_of_corners_are_those_of_the_file(tmp_path: Path, corner: str) -> None:
    """A roof of two slopes, shaded as if it were level on one side and as it is on the other."""
    lines = ["vt 0 0", "v -1 0 -1", "v -1 0 1", "v 0 1 -1", "v 0 1 1", "v 1 0 -1", "v 1 0 1"]
    lines += ["vn 0 3 0", "vn 1 1 0", "vn nan 0 0"]
    quads = (((1, -3), (2, 1), (4, 1), (3, 1)), ((3, 2), (4, 2), (6, 2), (5, 2)))
    lines += ["f " + " ".join(corner.format(*pair) for pair in quad) for quad in quads]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n")

    def normals(**more: Any) -> np.ndarray:
        mesh = StageMesh(file="a.obj", scale=(1, 0.5, 1), **more)
        return compile_meshes(Stage(meshes=(mesh,)), tmp_path).surfaces.corner_normals

    found = normals()
    np.testing.assert_allclose(found[:2], np.broadcast_to([0, 1, 0], (2, 3, 3)), atol=1e-6)
    # with half the height a slope is half as steep
    np.testing.assert_allclose(found[2:], np.broadcast_to([5**-0.5, 2 * 5**-0.5, 0], (2, 3, 3)), atol=1e-6)
    steep = normals(smooth_degrees=0)
    np.testing.assert_allclose(steep[:2], np.broadcast_to([-(5**-0.5), 2 * 5**-0.5, 0], (2, 3, 3)), atol=1e-6)
    # a normal that is no direction: that of the face
    (tmp_path / "a.obj").write_text("\n".join([*lines[:-2], lines[-2].replace("-3", "3")]) + "\n")
    np.testing.assert_allclose(normals(), steep[:2], atol=1e-6)
