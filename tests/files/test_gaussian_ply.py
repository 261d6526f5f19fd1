import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import read_ply
from octasplat.engine.files import read_metadata, read_scene
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata

Make = Callable[..., FlatGaussians]
TYPES = {"<f4": "float", "<f8": "double", "<i2": "short", "<u1": "uchar"}
SPLATS = ("inria_layout_9k_messy.ply", "playbot_lod3.ply", "biker.ply")


def columns_of(g: FlatGaussians, scales: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """The columns of a 3DGS file, written down anew and independently of the writer."""
    result = {name: g.means_world[:, k] for k, name in enumerate("xyz")}
    result |= {f"f_dc_{k}": g.sh[:, 0, k] for k in range(3)}
    rest = g.sh.shape[1] - 1
    result |= {f"f_rest_{c * rest + k}": g.sh[:, 1 + k, c] for c in range(3) for k in range(rest)}
    result["opacity"] = g.opacity_logits
    flat = np.full((len(g), 1), np.log(1e-5), np.float32)
    scales = np.concatenate([flat, g.log_scales], axis=1) if scales is None else scales
    result |= {f"scale_{k}": column for k, column in enumerate(scales.T)}
    return result | {f"rot_{k}": column for k, column in enumerate(g.quats_wxyz.T)}


def write_columns(path: Path, columns: dict[str, np.ndarray], layout: str = "binary_little_endian") -> Path:
    types = {
        name: TYPES[column.dtype.newbyteorder("<").str.replace("|", "<")] for name, column in columns.items()
    }
    count = len(next(iter(columns.values())))
    lines = ["ply", f"format {layout} 1.0", "comment made by a test", f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name, kind in types.items()]
    header = "\n".join([*lines, "end_header", ""]).encode()
    if layout == "ascii":
        rows = [" ".join(repr(column[row].item()) for column in columns.values()) for row in range(count)]
        path.write_bytes(header + "\n".join([*rows, ""]).encode())
    else:
        order = "<" if layout == "binary_little_endian" else ">"
        table = np.empty(
            count, dtype=[(name, order + column.dtype.str[1:]) for name, column in columns.items()]
        )
        for name, column in columns.items():
            table[name] = column
        path.write_bytes(header + table.tobytes())
    return path


def assert_same_bits(actual: FlatGaussians, expected: FlatGaussians) -> None:
    for name in ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh"):
        a, b = getattr(actual, name), getattr(expected, name)
        assert a.shape == b.shape and a.dtype == np.float32
        np.testing.assert_array_equal(a.view(np.uint32), b.view(np.uint32), err_msg=name)


def test_gaussian_ply_metadata_in_comments_round_trips(make_gaussians: Make, tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    facts = SceneMetadata(near_world=0.125, pixel_rad=1e-3, turned_beyond=0.5)
    write_gaussian_ply(make_gaussians(3), path, facts=facts)
    assert read_metadata(path) == read_metadata(tmp_path) == facts
    write_gaussian_ply(make_gaussians(3), path)
    assert read_metadata(path) == SceneMetadata()
    (tmp_path / "scene.splat").write_bytes(bytes(32))
    assert read_metadata(tmp_path / "scene.splat") == SceneMetadata()


@pytest.mark.parametrize("text", ["close", "nan", "inf"])
def test_gaussian_ply_non_numeric_metadata_is_refused(
    make_gaussians: Make, tmp_path: Path, text: str
) -> None:
    path = tmp_path / "scene.ply"
    write_gaussian_ply(make_gaussians(3), path, facts=SceneMetadata(near_world=0.125))
    path.write_bytes(path.read_bytes().replace(b"near_world 0.125", f"near_world {text}".encode()))
    with pytest.raises(SceneFileError, match=f"near_world is '{text}', which is no number"):
        read_metadata(path)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussian_ply_round_trip_is_bit_exact(make_gaussians: Make, tmp_path: Path, degree: int) -> None:
    g = make_gaussians(257, sh_degree=degree)
    g.log_scales[0] = -20.0  # thinner in its plane than our flat axis
    g.log_scales[1] = np.log(np.float32(1e-5))
    g.means_world[2] = -0.0
    write_gaussian_ply(g, tmp_path / "scene.ply")
    back, report = read_gaussian_ply(tmp_path / "scene.ply")
    assert_same_bits(back, g)
    assert (report.count, report.sh_degree, report.scale_count) == (257, degree, 3)
    assert (report.flattened, report.median_thickness, report.max_thickness, report.saturated) == (0, 0, 0, 0)


def test_file_has_the_standard_layout(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(3, sh_degree=1)
    write_gaussian_ply(g, tmp_path / "scene.ply")
    data = (tmp_path / "scene.ply").read_bytes()
    header, _, body = data.partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    names = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        *(f"f_dc_{k}" for k in range(3)),
        *(f"f_rest_{k}" for k in range(9)),
    ]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert lines[3:] == [f"property float {name}" for name in names]
    rows = np.frombuffer(body, "<f4").reshape(3, -1)
    expected = {"nx": np.zeros(3), "ny": np.zeros(3), "nz": np.zeros(3), **columns_of(g)}
    np.testing.assert_array_equal(rows, np.stack([expected[name] for name in names], axis=1))


def test_padding_adds_zero_harmonics(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(5, sh_degree=1)
    write_gaussian_ply(g, tmp_path / "scene.ply", sh_pad_degree=3)
    back, report = read_gaussian_ply(tmp_path / "scene.ply")
    assert report.sh_degree == 3
    np.testing.assert_array_equal(back.sh[:, :4], g.sh)
    np.testing.assert_array_equal(back.sh[:, 4:], 0)
    write_gaussian_ply(g, tmp_path / "scene.ply", sh_pad_degree=0)
    assert read_gaussian_ply(tmp_path / "scene.ply")[1].sh_degree == 1


@pytest.mark.parametrize("layout", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_properties_are_found_by_name_in_any_order_and_layout(
    make_gaussians: Make, tmp_path: Path, layout: str
) -> None:
    g = make_gaussians(40, sh_degree=2)
    columns = columns_of(g) | {"extra": np.arange(40, dtype=np.int16), "confidence": np.zeros(40, np.uint8)}
    columns["y"] = columns["y"].astype(np.float64)
    names = np.random.default_rng(0).permutation(list(columns))
    back, report = read_gaussian_ply(
        write_columns(tmp_path / "a.ply", {n: columns[n] for n in names}, layout)
    )
    assert_same_bits(back, g)
    assert report.flattened == 0


def test_gaussian_ply_integer_properties_are_converted(make_gaussians: Make, tmp_path: Path) -> None:
    columns = columns_of(make_gaussians(6)) | {"opacity": np.arange(6, dtype=np.int16) - 3}
    back, _ = read_gaussian_ply(write_columns(tmp_path / "a.ply", columns))
    np.testing.assert_array_equal(back.opacity_logits, [-3, -2, -1, 0, 1, 2])


def test_windows_line_ends_and_other_elements_are_accepted(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(4)
    path = write_columns(tmp_path / "a.ply", columns_of(g))
    header, _, body = path.read_bytes().partition(b"end_header\n")
    header = header.replace(b"element vertex", b"element camera 2\nproperty double focal\nelement vertex")
    header += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(header.replace(b"\n", b"\r\n") + bytes(16) + body + b"\x03" + bytes(12))
    assert_same_bits(read_gaussian_ply(path)[0], g)


def test_two_scales_are_those_in_the_plane(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(30)
    path = write_columns(tmp_path / "a.ply", columns_of(g, g.log_scales))
    back, report = read_gaussian_ply(path, dialect="games")
    assert_same_bits(back, g)
    assert (report.scale_count, report.flattened, report.notes) == (2, 0, ())
    surfels, report = read_scene(path)
    np.testing.assert_allclose(surfels.rotations, g.rotations[:, :, [2, 0, 1]], atol=1e-6)
    np.testing.assert_array_equal(surfels.log_scales, g.log_scales)
    assert "read as 2DGS" in report.notes[0] and "--format games" in report.notes[0]
    assert read_scene(path, "2dgs")[1].notes == ()


def test_thick_gaussians_lose_only_their_smallest_axis(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(200)
    scales = np.random.default_rng(1).normal(-3, 1, (200, 3)).astype(np.float32)
    back, report = read_gaussian_ply(write_columns(tmp_path / "a.ply", columns_of(g, scales)))
    smallest = np.argmin(scales, axis=1)
    assert set(smallest) == {0, 1, 2}
    axes = rotation_matrices(g.quats_wxyz.astype(np.float64)) * np.exp(scales.astype(np.float64))[:, None]
    axes[np.arange(200), :, smallest] = 0
    legs = back.rotations[:, :, 1:].astype(np.float64) * back.scales[:, None]
    np.testing.assert_allclose(
        legs @ legs.transpose(0, 2, 1), axes @ axes.transpose(0, 2, 1), rtol=1e-4, atol=1e-6
    )
    np.testing.assert_allclose(np.linalg.det(back.rotations), 1.0, atol=1e-5)
    lengths = np.linalg.norm(g.quats_wxyz, axis=1)
    np.testing.assert_allclose(np.linalg.norm(back.quats_wxyz, axis=1), lengths, rtol=1e-5)
    ordered = np.sort(np.exp(scales), axis=1)
    ratios = ordered[:, 0] / ordered[:, 1]
    assert report.flattened == 200
    assert report.median_thickness == pytest.approx(float(np.median(ratios)), rel=1e-5)
    assert report.max_thickness == pytest.approx(float(ratios.max()), rel=1e-5)


def test_gaussian_ply_equal_scales_keep_axes(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(10)
    g.log_scales[:] = -2.0
    scales = np.full((10, 3), -2.0, np.float32)
    back, report = read_gaussian_ply(write_columns(tmp_path / "a.ply", columns_of(g, scales)))
    assert_same_bits(back, g)
    assert (report.flattened, report.max_thickness) == (10, 1.0)


def test_infinite_logits_mean_opacity_one_or_zero(make_gaussians: Make, tmp_path: Path) -> None:
    columns = columns_of(make_gaussians(4)) | {"opacity": np.array([np.inf, -np.inf, 0, 1], np.float32)}
    back, report = read_gaussian_ply(write_columns(tmp_path / "a.ply", columns))
    assert report.saturated == 2
    assert back.is_finite()
    np.testing.assert_allclose(back.opacities[:3], [1, 0, 0.5], atol=1e-6)


@pytest.mark.parametrize("name", ["x", "f_dc_1", "opacity", "scale_1", "rot_3"])
def test_missing_property_is_named(make_gaussians: Make, tmp_path: Path, name: str) -> None:
    columns = columns_of(make_gaussians(4))
    del columns[name]
    with pytest.raises(SceneFileError, match=rf"a\.ply: .*lacks the property {name}\."):
        read_gaussian_ply(write_columns(tmp_path / "a.ply", columns))


def test_odd_counts_of_harmonics_are_refused(make_gaussians: Make, tmp_path: Path) -> None:
    columns = columns_of(make_gaussians(4, sh_degree=1))
    columns["f_rest_9"] = columns["f_rest_8"]
    with pytest.raises(SceneFileError, match="has 10 f_rest properties"):
        read_gaussian_ply(write_columns(tmp_path / "a.ply", columns))
    del columns["f_rest_3"]
    with pytest.raises(SceneFileError, match="f_rest_3 is missing"):
        read_gaussian_ply(write_columns(tmp_path / "a.ply", columns))


@pytest.mark.parametrize(
    ("name", "what"), [("y", "position"), ("rot_2", "rotation"), ("scale_1", "scale"), ("f_dc_0", "color")]
)
def test_nonfinite_values_are_counted(make_gaussians: Make, tmp_path: Path, name: str, what: str) -> None:
    columns = columns_of(make_gaussians(9))
    columns[name] = columns[name].copy()
    columns[name][[2, 5]] = [np.nan, np.inf]
    with pytest.raises(SceneFileError, match=f"2 of 9 Gaussians have no finite {what}"):
        read_gaussian_ply(write_columns(tmp_path / "a.ply", columns))


def test_value_beyond_float32_is_nonfinite(make_gaussians: Make, tmp_path: Path) -> None:
    columns = columns_of(make_gaussians(3))
    columns["x"] = np.array([0.0, 1e300, 1.0])
    with pytest.raises(SceneFileError, match="1 of 3 Gaussians have no finite position"):
        read_gaussian_ply(write_columns(tmp_path / "a.ply", columns))


@pytest.mark.parametrize("count", [70, 1])
@pytest.mark.parametrize("layout", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_map_coordinates_in_64_bits_keep_their_digits(
    make_gaussians: Make, tmp_path: Path, layout: str, count: int
) -> None:
    g = make_gaussians(count)
    placed = g.means_world.astype(np.float64) + np.array([691632.1, 5334761.4, 520.3])
    columns = columns_of(g) | dict(zip("xyz", placed.T, strict=True))
    path = write_columns(tmp_path / "a.ply", columns, layout)
    back, facts = read_scene(path)[0], read_metadata(path)
    # half a metre in 32 bits
    np.testing.assert_allclose(back.means_world + np.array(facts.origin_world), placed, rtol=0, atol=1e-6)
    write_gaussian_ply(back, tmp_path / "b.ply", facts=facts)
    assert read_metadata(tmp_path / "b.ply") == facts
    assert_same_bits(read_gaussian_ply(tmp_path / "b.ply")[0], back)


def test_64_bits_near_the_origin_are_read_as_they_are(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(70)
    columns = {name: column.astype(np.float64) for name, column in columns_of(g).items()}
    path = write_columns(tmp_path / "a.ply", columns)
    assert read_metadata(path) == SceneMetadata()
    assert_same_bits(read_gaussian_ply(path)[0], g)


def test_gaussian_ply_metadata_may_be_numbers_of_numpy(make_gaussians: Make, tmp_path: Path) -> None:
    x, y, z = np.array([512350.0, 5403210.0, 310.0])
    facts = SceneMetadata(near_world=np.float64(0.25), origin_world=(x, y, z))
    write_gaussian_ply(make_gaussians(2), tmp_path / "a.ply", facts=facts)
    assert read_metadata(tmp_path / "a.ply") == facts


def test_undefined_opacities_and_rotations_are_refused(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(5)
    g.opacity_logits[3] = np.nan
    with pytest.raises(SceneFileError, match="1 of 5 Gaussians have no finite opacity"):
        read_gaussian_ply(write_columns(tmp_path / "a.ply", columns_of(g)))
    with pytest.raises(SceneFileError, match="not finite"):
        write_gaussian_ply(g, tmp_path / "b.ply")
    g.opacity_logits[3] = 0.0
    g.quats_wxyz[:2] = 0.0
    with pytest.raises(SceneFileError, match="2 of 5 Gaussians have a rotation of length zero"):
        read_gaussian_ply(write_columns(tmp_path / "a.ply", columns_of(g)))


def test_empty_scenes_are_refused_both_ways(make_gaussians: Make, tmp_path: Path) -> None:
    none = make_gaussians(2).select(np.arange(0))
    with pytest.raises(SceneFileError, match="holds no Gaussians"):
        read_gaussian_ply(write_columns(tmp_path / "a.ply", columns_of(none)))
    with pytest.raises(SceneFileError, match="no Gaussians"):
        write_gaussian_ply(none, tmp_path / "b.ply")
    assert not (tmp_path / "b.ply").exists()


def test_lists_and_compressed_files_are_refused(make_gaussians: Make, tmp_path: Path) -> None:
    path = write_columns(tmp_path / "a.ply", columns_of(make_gaussians(2)))
    plain = path.read_bytes()
    path.write_bytes(plain.replace(b"property float opacity", b"property list uchar float opacity"))
    with pytest.raises(SceneFileError, match="'opacity' of element 'vertex' is a list"):
        read_gaussian_ply(path)
    path.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\n"
        b"element vertex 1\nproperty uint packed_position\nend_header\n" + bytes(8)
    )
    with pytest.raises(SceneFileError, match="is a compressed PLY; octasplat import"):
        read_gaussian_ply(path)


def test_gaussian_ply_of_mesh_names_missing_property(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    with pytest.raises(SceneFileError, match="not a PLY of Gaussians; it lacks the property y, z, f_dc_0"):
        read_gaussian_ply(path)
    path.write_bytes(b"ply\nformat ascii 1.0\nelement point 0\nproperty float x\nend_header\n")
    with pytest.raises(SceneFileError, match="no element 'vertex'"):
        read_gaussian_ply(path)


@pytest.mark.real
@pytest.mark.parametrize("name", SPLATS)
def test_files_of_other_programs_are_read(tmp_path: Path, name: str) -> None:
    scenes = os.environ.get("OCTASPLAT_SCENES")
    if not scenes:
        pytest.skip("OCTASPLAT_SCENES is not set")
    path = Path(scenes).parent / "splats" / name
    if not path.exists():
        pytest.skip(f"there is no folder 'splats' with {name} beside OCTASPLAT_SCENES")
    g, report = read_gaussian_ply(path)
    expected = {
        "inria_layout_9k_messy.ply": (9080, 3),
        "playbot_lod3.ply": (31000, 2),
        "biker.ply": (152746, 0),
    }
    assert (report.count, report.sh_degree) == expected[name]
    assert report.flattened == report.count
    assert g.is_finite()
    write_gaussian_ply(g, tmp_path / "own.ply")
    back, again = read_gaussian_ply(tmp_path / "own.ply")
    assert_same_bits(back, g)
    assert again.flattened == 0


def test_channels_are_properties_by_name(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(5)
    albedo = np.arange(15, dtype=np.float32).reshape(5, 3)
    metallic = np.arange(5, dtype=np.float32)[:, None]
    write_gaussian_ply(g.with_channels({"metallic": metallic, "albedo": albedo}), tmp_path / "a.ply")
    header, tables = read_ply(tmp_path / "a.ply", ["vertex"])
    assert tables["vertex"].dtype.names[-4:] == ("metallic", "albedo_0", "albedo_1", "albedo_2")
    assert header.comments == ("octasplat_channel metallic 1", "octasplat_channel albedo 3")
    np.testing.assert_array_equal(tables["vertex"]["albedo_2"], albedo[:, 2])
    assert_same_bits(read_gaussian_ply(tmp_path / "a.ply", channels=())[0], g)


def test_unknown_properties_become_channels_where_they_are_wanted(
    make_gaussians: Make, tmp_path: Path
) -> None:
    g = make_gaussians(6)
    own = columns_of(g)
    extra = {
        "semantic_1": np.arange(6), "Label": np.arange(6) * 2, "semantic_0": np.arange(6) * 3,
        "red": np.full(6, 255), "odd-name": np.zeros(6), "lonely_4": np.ones(6),
    }  # fmt: skip
    path = write_columns(tmp_path / "a.ply", {**own, **{k: v.astype(np.float32) for k, v in extra.items()}})
    assert read_gaussian_ply(path)[0].channels.widths == {}
    found, _ = read_gaussian_ply(path, channels="all")
    assert found.channels.widths == {"semantic": 2, "Label": 1, "lonely_4": 1}
    np.testing.assert_array_equal(found.channels["semantic"], np.stack([np.arange(6) * 3, np.arange(6)], 1))
    chosen, _ = read_gaussian_ply(path, channels=("Label",))
    assert chosen.channels.widths == {"Label": 1}
    write_gaussian_ply(found, tmp_path / "b.ply")
    assert read_gaussian_ply(tmp_path / "b.ply")[0].channels.widths == found.channels.widths
    with pytest.raises(
        SceneFileError, match=r"a\.ply: has no channel 'albedo'; it has semantic, Label, lonely_4"
    ):
        read_gaussian_ply(path, channels=("albedo",))


def test_nonfinite_channel_is_refused_by_name(make_gaussians: Make, tmp_path: Path) -> None:
    g = make_gaussians(4)
    label = np.array([0, np.nan, 2, 3], np.float32)
    path = write_columns(tmp_path / "a.ply", {**columns_of(g), "label": label})
    with pytest.raises(SceneFileError, match=r"1 of 4 Gaussians have no finite label"):
        read_gaussian_ply(path, channels="all")
    kept, report = read_gaussian_ply(path, channels="all", drop_invalid=True)
    assert kept.channels["label"][:, 0].tolist() == [0, 2, 3] and report.dropped == 1


@pytest.mark.parametrize(
    "comment", ["octasplat_channel albedo 3", "octasplat_channel x 1", "octasplat_channel"]
)
def test_comment_naming_absent_data_is_ignored(make_gaussians: Make, tmp_path: Path, comment: str) -> None:
    write_gaussian_ply(make_gaussians(4), tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content.replace(b"element", f"comment {comment}\nelement".encode(), 1))
    assert read_gaussian_ply(tmp_path / "a.ply")[0].channels.widths == {}
