from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import (
    PlyWriteElement,
    list_field,
    read_ply,
    read_ply_header,
    write_ply,
)

POINTS = "ply\nformat {layout} 1.0\nelement vertex 2\nproperty float x\nproperty short n\n"
FACES = "element face 2\nproperty uchar flag\nproperty list uchar int vertex_indices\nend_header\n"


def binary(order: str, lengths: tuple[int, int] = (3, 3)) -> bytes:
    points = np.array([(1.5, -2), (2.5, 7)], dtype=[("x", order + "f4"), ("n", order + "i2")]).tobytes()
    rows = [bytes([9, length]) + np.arange(length, dtype=order + "i4").tobytes() for length in lengths]
    return points + b"".join(rows)


@pytest.mark.parametrize("layout", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_scalars_and_lists_of_equal_length_are_read(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "a.ply"
    body = b"1.5 -2\n2.5 7\n\n9 3 0 1 2\n9 3 0 1 2\n"
    if layout != "ascii":
        body = binary("<" if "little" in layout else ">")
    path.write_bytes((POINTS + FACES).format(layout=layout).encode() + body)
    header, tables = read_ply(path, ["vertex", "face"])
    assert header.layout == layout
    np.testing.assert_array_equal(tables["vertex"]["x"], [1.5, 2.5])
    np.testing.assert_array_equal(tables["vertex"]["n"], [-2, 7])
    np.testing.assert_array_equal(tables["face"]["vertex_indices"], [[0, 1, 2], [0, 1, 2]])
    np.testing.assert_array_equal(tables["face"]["flag"], [9, 9])


@pytest.mark.parametrize("layout", ["binary_little_endian", "ascii"])
def test_elements_without_rows_are_read(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "a.ply"
    path.write_text((POINTS + FACES).format(layout=layout).replace(" 2\n", " 0\n"), encoding="ascii")
    _, tables = read_ply(path, ["vertex", "face"])
    assert len(tables["vertex"]["x"]) == len(tables["face"]["vertex_indices"]) == 0


def test_written_files_come_back_block_by_block(tmp_path: Path) -> None:
    dtype = np.dtype([("a", "<f8"), ("b", "u1"), *list_field("corners", "u4", 4)])
    rows = np.zeros(10, dtype)
    rows["a"], rows["b"], rows["corners__count"] = np.arange(10) / 3, np.arange(10), 4
    rows["corners"] = np.arange(40).reshape(10, 4)
    element = PlyWriteElement("quad", 10, dtype, [rows[:3], rows[3:7], rows[7:]])
    write_ply(tmp_path / "a.ply", [element], ["hello world"])
    header, tables = read_ply(tmp_path / "a.ply", ["quad"])
    assert header.comments == ("hello world",)
    np.testing.assert_array_equal(tables["quad"], rows)


def test_elements_after_the_last_one_wanted_are_not_looked_at(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(
        (POINTS + FACES).format(layout="binary_little_endian").encode() + binary("<", (3, 4))[:20]
    )
    np.testing.assert_array_equal(read_ply(path, ["vertex"])[1]["vertex"]["n"], [-2, 7])


def test_lists_of_unequal_length_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes((POINTS + FACES).format(layout="binary_little_endian").encode() + binary("<", (3, 4)))
    with pytest.raises(SceneFileError, match="'vertex_indices' of element 'face' differ in length"):
        read_ply(path, ["face"])
    path.write_bytes((POINTS + FACES).format(layout="ascii").encode() + b"1 1\n2 2\n9 3 0 1 2\n9 4 0 1 2 3\n")
    with pytest.raises(SceneFileError, match="'face'"):
        read_ply(path, ["face"])


@pytest.mark.parametrize("layout", ["binary_little_endian", "ascii"])
@pytest.mark.parametrize("keep", [0, 7])
def test_ply_truncated_reports_available_rows(tmp_path: Path, layout: str, keep: int) -> None:
    path = tmp_path / "a.ply"
    body = binary("<") if "binary" in layout else b"1.5 -2\n2.5 7\n"
    path.write_bytes((POINTS + FACES).format(layout=layout).encode() + body[:keep])
    with pytest.raises(
        SceneFileError, match=rf"a\.ply: is truncated; .*2 rows but only {keep // 6} are there"
    ):
        read_ply(path, ["vertex"])


def test_ply_huge_row_count_allocates_nothing(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n"
    )
    with pytest.raises(SceneFileError, match="truncated"):
        read_ply(path, ["vertex"])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not a PLY file"),
        (b"solid cube\n", "is not a PLY file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "is not a PLY file"),
        (b"ply\nformat ascii 1.0\n", "no 'end_header'"),
        (b"ply\nelement vertex 1\nproperty float x\nend_header\n", "no 'format' line"),
        (b"ply\nformat middle_endian 1.0\nend_header\n", "line 'format middle_endian 1.0'"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "line 'element vertex many'"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "line 'element vertex -1'"),
        (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "line 'property float x'"),
        (b"ply\nformat ascii 1.0\nelement v 1\nproperty quad x\nend_header\n", "line 'property quad x'"),
        (
            b"ply\nformat ascii 1.0\nelement v 1\nproperty list float int x\nend_header\n",
            "line 'property list",
        ),
        (
            b"ply\nformat ascii 1.0\nelement v 1\nproperty int x\nproperty int x\nend_header\n",
            "line 'property int x'",
        ),
        (b"ply\nformat ascii 1.0\nrubbish\nend_header\n", "line 'rubbish'"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nend_header\nnine\n", "not all numbers"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty int x\nend_header\n1 2\n", "hold 2 numbers"),
        (b"ply\nformat ascii 1.0\nelement point 0\nend_header\n", r"no element 'vertex' \(it has: point\)"),
    ],
)
def test_damaged_files_get_one_clear_sentence(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "damaged.ply"
    path.write_bytes(content)
    with pytest.raises(SceneFileError, match=message) as caught:
        read_ply(path, ["vertex"])
    assert "damaged.ply" in str(caught.value)


def test_missing_or_unwritable_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneFileError, match=r"none\.ply: cannot be read"):
        read_ply_header(tmp_path / "none.ply")
    (tmp_path / "folder.ply").mkdir()
    element = PlyWriteElement("vertex", 0, np.dtype([("x", "<f4")]), [])
    with pytest.raises(SceneFileError, match=r"folder\.ply: cannot be written"):
        write_ply(tmp_path / "folder.ply", [element])
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder.ply"]
