"""Files that are small and would be long to read, or large in memory: each is refused within a second."""

import gc
import json
import math
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import MAX_PROPERTIES
from octasplat.engine.files import importer_for, read_mesh
from octasplat.engine.files.mesh_obj import read_with_materials

LONGEST_SECONDS = 1.0
POINT = struct.pack("<3f", 1.0, 2.0, 3.0)


def glb(path: Path, binary: bytes = POINT, **document: Any) -> Path:
    """A GLB of one triangle whose corners are one point, with parts of its document replaced."""
    whole = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 1, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": len(binary)}],
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps({**whole, **document}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0")
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks) + len(binary)) + chunks + binary)
    return path


def doubling(path: Path) -> Path:
    """40 nodes, each with the next one twice: 2^40 nodes as a tree."""
    nodes: list[dict[str, Any]] = [{"children": [k + 1, k + 1]} for k in range(40)]
    return glb(path, nodes=[*nodes, {"mesh": 0}])


def sharing(path: Path) -> Path:
    """Ten layers of nodes, each of which has all nodes of the next layer."""
    nodes: list[dict[str, Any]] = [{"children": list(range(1, 21))}]
    for layer in range(10):
        first = 1 + 20 * (layer + 1)
        nodes += [{"children": list(range(first, first + 20))} for _ in range(20)]
    return glb(path, nodes=[*nodes, *[{"mesh": 0} for _ in range(20)]])


def many_primitives(path: Path) -> Path:
    """1,000 nodes that show a mesh of 1,000 primitives."""
    nodes = [{"mesh": 0} for _ in range(1000)]
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}}] * 1000}]
    return glb(path, nodes=nodes, scenes=[{"nodes": list(range(1000))}], meshes=meshes)


def overlapping_rows(path: Path) -> Path:
    """2^40 rows that are all the same twelve bytes."""
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 1 << 40, "type": "VEC3"}]
    views = [{"buffer": 0, "byteLength": 12, "byteStride": 0}]
    return glb(path, accessors=accessors, bufferViews=views)


def endless_count(path: Path) -> Path:
    """A count of rows beyond the numbers of 64 bits."""
    accessors = [{"bufferView": 0, "componentType": 5126, "count": math.inf, "type": "VEC3"}]
    return glb(path, accessors=accessors)


def endless_offset(path: Path) -> Path:
    """Data that begin beyond the numbers of 64 bits."""
    return glb(path, bufferViews=[{"buffer": 0, "byteLength": 12, "byteOffset": 10**30}])


def deep_json(path: Path) -> Path:
    glb(path)
    text = b'{"a":' * 200_000 + b"1" + b"}" * 200_000
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, 20 + len(text)) + struct.pack("<I4s", len(text), b"JSON") + text
    )
    return path


def empty_chunks(path: Path) -> Path:
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 0) + struct.pack("<I4s", 0, b"OTHR") * 1_500_000)
    return path


def wide_channels(path: Path) -> Path:
    channels = {f"c{number}": 60_000 for number in range(1000)}
    return glb(path, asset={"version": "2.0", "extras": {"octasplat_channels": channels}})


def ply(path: Path, lines: list[str], data: bytes = b"") -> Path:
    head = ["ply", "format binary_little_endian 1.0", *lines, "end_header", ""]
    path.write_bytes("\n".join(head).encode() + data)
    return path


def many_properties(path: Path) -> Path:
    return ply(path, ["element vertex 1", *(f"property char a{k}" for k in range(50_000))], b"\0" * 50_000)


def hundred_thousand_properties(path: Path) -> Path:
    return ply(path, ["element vertex 1", *(f"property char {k}" for k in range(100_000))], b"\0" * 100_000)


def many_elements(path: Path) -> Path:
    return ply(path, [f"element e{k} 0" for k in range(60_000)])


def wide_comments(path: Path) -> Path:
    """A scene, nearly, whose comments declare 20,000 channels of 65,535 columns each."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2"]
    comments = [f"comment octasplat_channel c{k} 65535" for k in range(20_000)]
    properties = [f"property float {name}" for name in [*names, "rot_3"]]
    return ply(path, [*comments, "element vertex 1", *properties], struct.pack("<14f", *range(13), np.nan))


def long_lists(path: Path) -> Path:
    lines = ["element vertex 1", *(f"property list uint double l{k}" for k in range(5000))]
    return ply(path, lines, struct.pack("<I", 1 << 16) + b"\1" * (1 << 20))


def no_line_end(path: Path) -> Path:
    with path.open("wb") as handle:
        handle.write(b"v 0 0 ")
        handle.truncate(3 << 30)  # sparse: on the disk it is one block
    return path


READERS: dict[str, Callable[[Path], object]] = {
    "mesh": read_mesh,
    "scene": lambda path: importer_for(path).read(path),
}
ATTACKS: list[tuple[Callable[[Path], Path], str, str]] = [
    *((make, "a.glb", "mesh") for make in (doubling, sharing, many_primitives, overlapping_rows)),
    *((make, "a.glb", "mesh") for make in (deep_json, empty_chunks, endless_count, endless_offset)),
    *((make, "a.glb", "scene") for make in (doubling, many_primitives, wide_channels)),
    *((make, "a.ply", "mesh") for make in (many_properties, hundred_thousand_properties, many_elements)),
    *((make, "a.ply", "scene") for make in (many_properties, long_lists)),
    (no_line_end, "a.obj", "mesh"),
]


@pytest.mark.parametrize(
    ("make", "name", "reader"), ATTACKS, ids=[f"{a[0].__name__}-{a[2]}" for a in ATTACKS]
)
def test_hostile_file_is_refused_within_a_second(
    tmp_path: Path, make: Callable[[Path], Path], name: str, reader: str
) -> None:
    path = make(tmp_path / name)
    gc.collect()  # what other tests have left is not the reader's work
    begun = time.process_time()
    with pytest.raises(SceneFileError, match=r"a\.(glb|ply|obj): ") as refusal:
        READERS[reader](path)
    assert time.process_time() - begun < LONGEST_SECONDS
    assert str(refusal.value).rstrip(".").count("\n") == 0


def test_comments_that_declare_more_columns_than_a_file_has_are_passed_over(tmp_path: Path) -> None:
    path = wide_comments(tmp_path / "a.ply")
    begun = time.process_time()
    cloud: Any = READERS["scene"](path)
    assert time.process_time() - begun < LONGEST_SECONDS
    assert len(cloud.means_world) == 1 and not cloud.channels.widths


@pytest.mark.exhaustive
def test_obj_with_many_material_changes_is_read_in_linear_time(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "usemtl a\n" * 400_000 + "f 1 2 3\n")
    begun = time.process_time()
    mesh = read_with_materials(path)
    assert time.process_time() - begun < 10 * LONGEST_SECONDS
    assert len(mesh.triangles) == 1


def test_most_properties_are_still_read(tmp_path: Path) -> None:
    names = [f"channel_{k}" for k in range(MAX_PROPERTIES - 14)]
    known = ["x", "y", "z", *(f"f_dc_{k}" for k in range(3)), "opacity", *(f"scale_{k}" for k in range(3))]
    properties = [f"property float {name}" for name in [*known, *(f"rot_{k}" for k in range(4)), *names]]
    path = ply(
        tmp_path / "a.ply", ["element vertex 2", *properties], np.ones((2, MAX_PROPERTIES), "<f4").tobytes()
    )
    begun = time.process_time()
    cloud = importer_for(path).read(path, "all")
    assert cloud.channels.widths == {"channel": MAX_PROPERTIES - 14}
    assert time.process_time() - begun < 5 * LONGEST_SECONDS
