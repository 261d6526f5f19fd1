"""Meshes as other programs write them."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import COUNT_SUFFIX, PlyWriteElement, list_field, write_ply
from octasplat.engine.files import obj_parser, read_mesh


def obj(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mesh.obj"
    path.write_text(text, encoding="utf-8")
    return path


def glb(tmp_path: Path, document: dict[str, Any], binary: bytes) -> Path:
    text = json.dumps(document).encode()
    text = text.ljust(-(-len(text) // 4) * 4)
    content = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0")
    path = tmp_path / "mesh.glb"
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(content) + len(binary)) + content + binary)
    return path


TWO_QUADS = """# a comment
# octasplat_q 4.5
mtllib none.mtl
o thing
v 0 0 0 1 1 1
v 1 0 0 1 1 1
v 1 1 0 1 1 1
v 0 1 0 1 1 1
vn 0 0 1
v -1e-3 +2.5 1E+1
v .5 -.5 3
vt 0 0
vt 1.0 0.0
vt 1 1
vt 0 1
s off
f 1/1/1 2/2/1 3/3/1 4/4/1
f 5 6 1
f -1 -2 -3
"""


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("block", [1 << 26, 64])
def test_obj_with_all_kinds_of_lines(tmp_path: Path, monkeypatch, line_end: str, block: int) -> None:
    monkeypatch.setattr(obj_parser, "BLOCK_BYTES", block)
    mesh = read_mesh(obj(tmp_path, TWO_QUADS.replace("\n", line_end)))
    np.testing.assert_array_equal(mesh.vertices[4:], [[-1e-3, 2.5, 10], [0.5, -0.5, 3]])
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2], [0, 2, 3], [4, 5, 0], [5, 4, 3]])
    np.testing.assert_array_equal(mesh.uv[:4], [[0, 0], [1, 0], [1, 1], [0, 1]])
    assert np.isnan(mesh.uv[4:]).all()
    assert mesh.q == 4.5 and mesh.gid is None


def test_obj_without_texture_numbers_or_with_empty_ones(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\nf 3 2 1\n"
    mesh = read_mesh(obj(tmp_path, text))
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2], [2, 1, 0]])
    assert mesh.uv is None


def test_obj_faces_whose_counts_add_up_by_chance(tmp_path: Path) -> None:
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 1 1\nv 1 1 1\nf 1 2 3 4\nf 1 2 3\nf 1 2 3 4 5\n"
    mesh = read_mesh(obj(tmp_path, text))
    np.testing.assert_array_equal(
        mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4]]
    )


@pytest.mark.parametrize("block", [16, 1 << 22])
def test_obj_relative_numbers_count_back_from_their_own_line(tmp_path: Path, monkeypatch, block: int) -> None:
    monkeypatch.setattr(obj_parser, "BLOCK_BYTES", block)
    lines = []
    for k in range(3):  # triangles one after the other, each behind its own vertices
        lines += [f"v {k} {corner} 0" for corner in range(3)]
        lines += [f"vt {k / 4} {corner / 4}" for corner in range(3)]
        lines += ["f -3/-3 -2/-2 -1/-1"]
    lines += ["f -9// -8// -7//", "f -1 -2 -3 -4"]  # the slow way, and a polygon of relative numbers
    mesh = read_mesh(obj(tmp_path, "\n".join([*lines, ""])))
    expected = [[0, 1, 2], [3, 4, 5], [6, 7, 8], [0, 1, 2], [8, 7, 6], [8, 6, 5]]
    assert mesh.triangles.tolist() == expected
    assert mesh.uv is not None
    np.testing.assert_allclose(mesh.uv[:, 0], np.repeat([0, 0.25, 0.5], 3))


def test_obj_with_bom_or_indentation_is_read(tmp_path: Path) -> None:
    path = obj(tmp_path, "\ufeffv 0 0 0\n  v 1 0 0\n\tv 0 1 0\n f 1 2 3\n")
    mesh = read_mesh(path)
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert mesh.triangles.tolist() == [[0, 1, 2]]


def test_mtl_with_bom_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.mtl").write_text("\ufeffnewmtl red\nKd 1 0 0\n", encoding="utf-8")
    path = obj(tmp_path, "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n")
    assert [material.name for material in read_mesh(path, with_materials=True).materials] == ["red"]
    assert read_mesh(path, with_materials=True).materials[0].unsupported == ()


def test_obj_rounding_follows_the_digits(tmp_path: Path) -> None:
    assert read_mesh(obj(tmp_path, "v 0.123 1.5 2\nv 0 0 0\n")).rounding == pytest.approx(5e-4)
    assert read_mesh(obj(tmp_path, "v 0.123456 1.5 2\n")).rounding == pytest.approx(5e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello\n", "no line that begins with 'v'"),
        ("v 0 0 x\n", "'v' holds something that is no number"),
        ("v 0 0\n", "fewer than three"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "names a vertex that is not there"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -9\n", "names a vertex that is not there"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf a b c\n", "'f' holds something that is no number"),
        ("v 0 0 nan\n", "not finite"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//2\n", "a normal that is not there"),
    ],
)
def test_obj_damaged_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SceneFileError, match=r"mesh\.obj.*" + message):
        read_mesh(obj(tmp_path, text), with_materials=True)


def triangle_document(**changes: Any) -> tuple[dict[str, Any], bytes]:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    gid = np.array([7, 7, 7], "<f4")
    corner = np.array([0, 1, 2], np.uint8)
    binary = positions.tobytes() + gid.tobytes() + corner.tobytes().ljust(4, b"\0")
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"rotation": [2**-0.5, 0, 0, 2**-0.5], "translation": [0, 0, 10], "children": [1]},
            {"mesh": 0, "scale": [2, 3, 4]},
            {"mesh": 0},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "_GID": 1, "_CORNER": 2}}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 0, "byteOffset": 36, "componentType": 5126, "count": 3, "type": "SCALAR"},
            {"bufferView": 0, "byteOffset": 48, "componentType": 5121, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 52}],
        "buffers": [{"byteLength": 52}],
    }
    # One view without a stride holds all three, which is legal while each is tightly packed.
    return document | changes, binary


def test_glb_nodes_move_their_meshes_and_only_the_scene_counts(tmp_path: Path) -> None:
    mesh = read_mesh(glb(tmp_path, *triangle_document()))
    np.testing.assert_allclose(mesh.vertices, [[0, 0, 10], [2, 0, 10], [0, 0, 13]], atol=1e-12)
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2]])
    np.testing.assert_array_equal(mesh.gid, [7, 7, 7])
    np.testing.assert_array_equal(mesh.corner, [0, 1, 2])
    assert mesh.uv is None and mesh.radius is None


def test_glb_node_with_a_matrix(tmp_path: Path) -> None:
    matrix = [0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]  # column by column
    document, binary = triangle_document(nodes=[{"mesh": 0, "matrix": matrix}])
    np.testing.assert_allclose(
        read_mesh(glb(tmp_path, document, binary)).vertices, [[5, 6, 7], [5, 7, 7], [4, 6, 7]]
    )


@pytest.mark.parametrize(
    ("mode", "triangles"),
    [(4, []), (5, [[0, 1, 2], [1, 3, 2], [2, 3, 4]]), (6, [[1, 2, 0], [2, 3, 0], [3, 4, 0]])],
    ids=["neither", "strip", "fan"],
)
def test_glb_strips_and_fans_are_read(tmp_path: Path, mode: int, triangles: list[list[int]]) -> None:
    positions = np.arange(15, dtype="<f4")
    document, _ = triangle_document(
        meshes=[
            {
                "primitives": [
                    {"attributes": {"POSITION": 0}, "mode": mode, **({} if triangles else {"indices": 1})}
                ]
            }
        ],
        nodes=[{"mesh": 0}],
        accessors=[
            {"bufferView": 0, "componentType": 5126, "count": 5, "type": "VEC3"},
            {"bufferView": 0, "byteOffset": 60, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        bufferViews=[{"buffer": 0, "byteLength": 68}],
        buffers=[{"byteLength": 68}],
    )
    binary = positions.tobytes() + np.array([0, 2, 4, 0], "<u2").tobytes()
    found = read_mesh(glb(tmp_path, document, binary)).triangles
    np.testing.assert_array_equal(found, triangles or [[0, 2, 4]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"extensionsUsed": ["KHR_draco_mesh_compression"]}, "without compression"),
        ({"nodes": [{"children": [0]}]}, "circle"),
        ({"accessors": []}, "damaged"),
        ({"bufferViews": [{"buffer": 0, "byteOffset": 40, "byteLength": 52}]}, "damaged"),
        ({"buffers": [{"byteLength": 52, "uri": "mesh.bin"}]}, "another file"),
        ({"meshes": 3}, "damaged"),
        ({"scenes": [{"nodes": []}]}, "holds no vertices"),
    ],
)
def test_glb_damaged_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneFileError, match=r"mesh\.glb.*" + message):
        read_mesh(glb(tmp_path, *triangle_document(**changes)))


def test_glb_truncated_is_refused(tmp_path: Path) -> None:
    path = glb(tmp_path, *triangle_document())
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(SceneFileError, match="truncated"):
        read_mesh(path)


def test_ply_polygons_become_fans(tmp_path: Path) -> None:
    vertices = np.zeros(4, dtype=[(name, "<f8") for name in "xyz"])
    vertices["x"] = [0, 1, 1, 0]
    faces = np.zeros(1, dtype=list_field("vertex_index", "i4", 4))
    faces["vertex_index"], faces["vertex_index" + COUNT_SUFFIX] = [0, 1, 2, 3], 4
    path = tmp_path / "mesh.ply"
    write_ply(
        path,
        [
            PlyWriteElement("vertex", 4, vertices.dtype, [vertices]),
            PlyWriteElement("face", 1, faces.dtype, [faces]),
        ],
    )
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(mesh.vertices[:, 0], [0, 1, 1, 0])


@pytest.mark.parametrize("corner", [-5, -1, 3])
def test_ply_face_of_no_vertex_is_refused(tmp_path: Path, corner: int) -> None:
    vertices = np.zeros(
        3, dtype=[*((name, "<f4") for name in "xyz"), ("nx", "<f4"), ("ny", "<f4"), ("nz", "<f4")]
    )
    faces = np.zeros(1, dtype=list_field("vertex_indices", "i4", 3))
    faces["vertex_indices"], faces["vertex_indices" + COUNT_SUFFIX] = [0, 1, corner], 3
    path = tmp_path / "mesh.ply"
    elements = (("vertex", vertices), ("face", faces))
    write_ply(path, [PlyWriteElement(name, len(rows), rows.dtype, [rows]) for name, rows in elements])
    for with_materials in (False, True):
        with pytest.raises(SceneFileError, match="names a vertex that is not there"):
            read_mesh(path, with_materials=with_materials)


def test_ply_with_lists_at_its_vertices_is_read(tmp_path: Path) -> None:
    # trimesh 5 writes colors so.
    fields = [*((name, "<f4") for name in "xyz"), *list_field("color", "u1", 4), ("s", "<f8"), ("t", "<f8")]
    vertices = np.zeros(3, dtype=fields)
    vertices["x"], vertices["s"] = [0, 1, 2], [0.25, 0.5, 1]
    vertices["color" + COUNT_SUFFIX] = 4
    path = tmp_path / "mesh.ply"
    write_ply(path, [PlyWriteElement("vertex", 3, vertices.dtype, [vertices])])
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices[:, 0], [0, 1, 2])
    np.testing.assert_array_equal(mesh.uv[:, 0], np.float32([0.25, 0.5, 1]))


def test_ply_with_a_list_for_a_coordinate_is_refused_by_its_name(tmp_path: Path) -> None:
    rows = np.zeros(1, dtype=[("x", "<f4"), ("y", "<f4"), *list_field("z", "f4", 2)])
    rows["z" + COUNT_SUFFIX] = 2
    path = tmp_path / "mesh.ply"
    write_ply(path, [PlyWriteElement("vertex", 1, rows.dtype, [rows])])
    with pytest.raises(SceneFileError, match=r"lack the property z\."):
        read_mesh(path)


def test_ply_of_gaussians_is_no_mesh(tmp_path: Path) -> None:
    rows = np.zeros(2, dtype=[(name, "<f4") for name in ("x", "y", "z", "f_dc_0")])
    path = tmp_path / "scene.ply"
    write_ply(path, [PlyWriteElement("vertex", 2, rows.dtype, [rows])])
    with pytest.raises(SceneFileError, match="is a file of Gaussians, not a mesh"):
        read_mesh(path)


def test_mesh_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneFileError, match=r"save it as \.glb, \.ply or \.obj"):
        read_mesh(tmp_path / "mesh.fbx")


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
@pytest.mark.parametrize("block", range(8, 40))
def test_obj_lines_that_go_on_are_joined_at_the_end_of_a_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line_end: str, block: int
) -> None:
    monkeypatch.setattr(obj_parser, "BLOCK_BYTES", block)
    text = "v 0 0 0\nv 1 0 \\\n0\nv 0 1 0\nf 1 2 \\\n\\\n3\nf 3 2 1\n"
    mesh = read_mesh(obj(tmp_path, text.replace("\n", line_end)))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert mesh.triangles.tolist() == [[0, 1, 2], [2, 1, 0]]


def test_obj_of_lines_of_two_corners_has_no_triangles(tmp_path: Path) -> None:
    mesh = read_mesh(obj(tmp_path, "v 0 0 0\nv 1 0 0\nf 1 2\nf 2 1\n"))
    assert len(mesh.triangles) == 0
