from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import PlyWriteElement, write_ply
from octasplat.engine.files import export_scene, exporter_for, importer_for, read_scene
from octasplat.engine.gaussians.flattening import GaussianCloud
from octasplat.engine.gaussians.model import FlatGaussians
from tests.support.cloud_difference import difference

Make = Callable[..., GaussianCloud]
CHUNK = 256
SH_C0 = 0.28209479177387814


def pack_unit(values: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    word = np.zeros(len(values), np.uint64)
    for place, size in enumerate(bits):
        steps = (1 << size) - 1
        field = np.rint(np.clip(values[:, place], 0, 1) * steps).astype(np.uint64)
        word = (word << np.uint64(size)) | field
    return word.astype(np.uint32)


def write_compressed(path: Path, cloud: GaussianCloud, *, color_bounds: bool = True) -> None:
    """The encoder of the format, chunk by chunk."""
    n = len(cloud.means_world)
    rgb = 0.5 + SH_C0 * cloud.sh[:, 0]
    groups = {"": cloud.means_world, "scale_": cloud.log_scales, "rgb": rgb}
    names = {"": "xyz", "scale_": "xyz", "rgb": "rgb"}
    chunk_rows: list[dict[str, float]] = []
    shares = {key: np.zeros_like(values) for key, values in groups.items()}
    for start in range(0, n, CHUNK):
        part = slice(start, start + CHUNK)
        row: dict[str, float] = {}
        for key, values in groups.items():
            low, high = values[part].min(axis=0), values[part].max(axis=0)
            if key == "rgb" and not color_bounds:
                shares[key][part] = values[part]
                continue
            shares[key][part] = (values[part] - low) / np.maximum(high - low, 1e-9)
            prefix = "" if key == "rgb" else key
            for axis, name in enumerate(names[key]):
                row[f"min_{prefix}{name}"], row[f"max_{prefix}{name}"] = low[axis], high[axis]
        chunk_rows.append(row)
    opacity = 1 / (1 + np.exp(-cloud.opacity_logits))
    quats = cloud.quats_wxyz / np.linalg.norm(cloud.quats_wxyz, axis=1, keepdims=True)
    rotation = np.zeros(n, np.uint32)
    for i, q in enumerate(quats):
        largest = int(np.argmax(np.abs(q)))
        q = q if q[largest] > 0 else -q
        others = np.delete(q, largest) / np.sqrt(2) + 0.5
        rotation[i] = (largest << 30) | int(pack_unit(others[None], (10, 10, 10))[0])
    vertices = np.empty(
        n, dtype=[(f"packed_{what}", "<u4") for what in ("position", "rotation", "scale", "color")]
    )
    vertices["packed_position"] = pack_unit(shares[""], (11, 10, 11))
    vertices["packed_rotation"] = rotation
    vertices["packed_scale"] = pack_unit(shares["scale_"], (11, 10, 11))
    vertices["packed_color"] = pack_unit(np.column_stack([shares["rgb"], opacity]), (8, 8, 8, 8))
    chunks = np.array([tuple(row.values()) for row in chunk_rows], dtype=[(k, "<f4") for k in chunk_rows[0]])
    elements = [
        PlyWriteElement("chunk", len(chunks), chunks.dtype, [chunks]),
        PlyWriteElement("vertex", n, vertices.dtype, [vertices]),
    ]
    rest = cloud.sh[:, 1:].transpose(0, 2, 1).reshape(n, -1)
    if rest.shape[1]:
        table = np.empty(n, dtype=[(f"f_rest_{k}", "u1") for k in range(rest.shape[1])])
        for k in range(rest.shape[1]):
            table[f"f_rest_{k}"] = np.clip(np.floor((rest[:, k] / 8 + 0.5) * 256), 0, 255)
        elements.append(PlyWriteElement("sh", n, table.dtype, [table]))
    write_ply(path, elements)


@pytest.mark.parametrize(("degree", "count"), [(0, 1), (1, 256), (2, 257), (3, 700)])
def test_values_come_back_within_their_quantum(
    make_cloud: Make, tmp_path: Path, degree: int, count: int
) -> None:
    cloud = make_cloud(count, degree)
    path = tmp_path / "a.compressed.ply"
    write_compressed(path, cloud)
    assert importer_for(path).name == "compressed-ply"
    back = importer_for(path).read(path)
    # Half a step: 6 units / 1023, 5 / 1023 in ln, sqrt(2) / 1023 a component, one color / 255, 8 / 256.
    difference(back, cloud).assert_below(
        position=0.5 * 6 / 1023 * 1.001,
        rotation_degrees=0.25,
        log_scale=0.5 * 5 / 1023 * 1.001,
        opacity=0.502 / 255,
        sh=max(0.502 / 255 / SH_C0, 8 / 512 * 1.001),
    )


@pytest.mark.parametrize(("degree", "count"), [(0, 1), (3, 3000)])
def test_compressed_ply_round_trips(tmp_path: Path, degree: int, count: int) -> None:
    random = np.random.default_rng(7)
    scene = FlatGaussians(
        random.uniform(-3, 3, (count, 3)).astype(np.float32),
        random.standard_normal((count, 4)).astype(np.float32),
        random.uniform(-6, -1, (count, 2)).astype(np.float32),
        random.uniform(-4, 4, count).astype(np.float32),
        random.uniform(-1, 1, (count, (degree + 1) ** 2, 3)).astype(np.float32),
    )
    assert exporter_for(tmp_path / "a.compressed.ply").name == "compressed-ply"
    export_scene(scene, tmp_path / "a.compressed.ply")
    back, report = read_scene(tmp_path / "a.compressed.ply")
    assert (len(back), report.sh_degree, report.flattened) == (count, degree, 0)
    # Sorted along a curve; the nearest of ours in place is the same one, once each.
    distances = np.linalg.norm(back.means_world[:, None] - scene.means_world[None], axis=2)
    ours = distances.argmin(axis=1)
    assert len(np.unique(ours)) == count
    scene = scene.select(ours)
    # The chunks are compact, so that steps are far smaller than those of the whole scene, 6 / 1023.
    np.testing.assert_allclose(back.means_world, scene.means_world, atol=0.5 * 6 / 1023)
    assert count == 1 or np.abs(back.means_world - scene.means_world).mean() < 0.2 * 6 / 1023
    np.testing.assert_allclose(back.log_scales, scene.log_scales, atol=0.5 * 5 / 1023 * 1.001)
    np.testing.assert_allclose(back.opacities, scene.opacities, atol=0.502 / 255)
    np.testing.assert_allclose(back.sh[:, 0], scene.sh[:, 0], atol=0.502 / 255 / SH_C0)
    np.testing.assert_allclose(back.sh[:, 1:], scene.sh[:, 1:], atol=8 / 512 * 1.001)
    normals = np.abs(np.sum(back.rotations[:, :, 0] * scene.rotations[:, :, 0], axis=1))
    assert np.degrees(np.arccos(np.clip(normals, -1, 1))).max() < 0.25


@pytest.mark.parametrize("far", [0, 1, 40])
def test_compressed_ply_outliers_keep_precision(tmp_path: Path, far: int) -> None:
    random = np.random.default_rng(5)
    count, sigma = 20_000, 0.01
    means = random.uniform(-1, 1, (count, 3))
    means[:far] = 1e4 * random.standard_normal((far, 3))
    scene = FlatGaussians(
        means.astype(np.float32),
        random.standard_normal((count, 4)).astype(np.float32),
        np.full((count, 2), np.log(sigma), np.float32),
        np.zeros(count, np.float32),
        random.uniform(-1, 1, (count, 1, 3)).astype(np.float32),
    )
    export_scene(scene, tmp_path / "a.compressed.ply")
    back, _ = read_scene(tmp_path / "a.compressed.ply")
    errors, _ = cKDTree(back.means_world).query(scene.means_world[far:])
    # 78 chunks share a cube of side 2: cells of about 0.5, whose steps are 0.5 / 2047 = 0.024 sigma.
    assert np.median(errors) / sigma < 0.03
    assert (errors > 0.1 * sigma).mean() < (0.0001 if far == 0 else 8 * 256 / count)


def test_older_files_without_bounds_of_colors(make_cloud: Make, tmp_path: Path) -> None:
    cloud = make_cloud(300)
    write_compressed(tmp_path / "a.ply", cloud, color_bounds=False)
    assert importer_for(tmp_path / "a.ply").name == "compressed-ply"
    back, report = read_scene(tmp_path / "a.ply")
    assert (report.count, report.flattened) == (300, 300)
    np.testing.assert_allclose(back.base_rgb_srgb, 0.5 + SH_C0 * cloud.sh[:, 0], atol=0.502 / 255)


def test_compressed_ply_inconsistent_file_is_refused(make_cloud: Make, tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    write_compressed(path, make_cloud(300, 1))
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"element chunk 2", b"element chunk 1"))
    with pytest.raises(SceneFileError, match="has 1 chunks for 300 Gaussians"):
        read_scene(path)
    path.write_bytes(whole.replace(b"max_scale_y", b"top_scale_y"))
    with pytest.raises(SceneFileError, match="lacks the property max_scale_y"):
        read_scene(path)
    path.write_bytes(whole.replace(b"f_rest_8", b"f_rest_9"))
    with pytest.raises(SceneFileError, match="element 'sh' should hold"):
        read_scene(path)
    path.write_bytes(whole.replace(b"uint packed_scale", b"float packed_scale"))
    with pytest.raises(SceneFileError, match="packed_scale should be of type uint"):
        read_scene(path)
    path.write_bytes(whole[:-5])
    with pytest.raises(SceneFileError, match="is truncated"):
        read_scene(path)
