import gzip
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files import importer_for, read_scene
from octasplat.engine.files.gaussian_ply import read_ply_cloud
from octasplat.engine.gaussians.flattening import GaussianCloud
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.rows import concatenate_rows
from octasplat.engine.gaussians.spherical_harmonics import sh_basis
from tests.support.cloud_difference import difference

Make = Callable[..., GaussianCloud]
BITS = 12
DIRECTION = np.array([0.36, 0.48, 0.8])
SH_SIGNS = np.sign(sh_basis(DIRECTION * (1, -1, -1), 3) * sh_basis(DIRECTION, 3))
"""Parity of each harmonic under y -> -y, z -> -z."""


def pack(cloud: GaussianCloud, version: int, degree: int | None = None) -> tuple[bytes, list[bytes]]:
    """Header and attributes of an SPZ, one Gaussian after another."""
    positions, alphas, colors, scales, rotations, harmonics = (bytearray() for _ in range(6))
    for i in range(len(cloud.means_world)):
        for value in cloud.means_world[i] * (1, -1, -1):
            positions += round(float(value) * (1 << BITS)).to_bytes(3, "little", signed=True)
        alphas.append(round(255 / (1 + np.exp(-cloud.opacity_logits[i]))))
        colors += bytes(round(255 * (0.15 * float(value) + 0.5)) for value in cloud.sh[i, 0])
        scales += bytes(round((float(value) + 10) * 16) for value in cloud.log_scales[i])
        w, x, y, z = cloud.quats_wxyz[i] / np.linalg.norm(cloud.quats_wxyz[i])
        xyzw = np.array([x, -y, -z, w])
        if version == 2:
            xyzw = xyzw if xyzw[3] >= 0 else -xyzw
            rotations += bytes(round(127.5 * value + 127.5) for value in xyzw[:3])
        else:
            largest = int(np.argmax(np.abs(xyzw)))
            xyzw = xyzw if xyzw[largest] > 0 else -xyzw
            word = largest
            for place in range(4):
                if place != largest:
                    size = round(511 * abs(xyzw[place]) * np.sqrt(2))
                    word = (word << 10) | (int(xyzw[place] < 0) << 9) | size
            rotations += struct.pack("<I", word)
        for k in range(1, cloud.sh.shape[1]):
            harmonics += bytes(
                int(np.clip(round(128 * float(v) * SH_SIGNS[k] + 128), 0, 255)) for v in cloud.sh[i, k]
            )
    own = int(np.sqrt(cloud.sh.shape[1])) - 1
    header = struct.pack(
        "<4sIIBBBB", b"NGSP", version, len(cloud.means_world), own if degree is None else degree, BITS, 0, 0
    )
    return header, [bytes(b) for b in (positions, alphas, colors, scales, rotations, harmonics)]


def write_spz(
    path: Path, cloud: GaussianCloud, version: int, flags: int = 0, records: bytes = b"", tree: bytes = b""
) -> None:
    header, streams = pack(cloud, version)
    header = header[:14] + bytes([flags]) + header[15:]
    if version < 4:
        path.write_bytes(gzip.compress(header + b"".join(streams) + tree + records))
        return
    streams = [stream for stream in streams if stream]
    packed = [zstandard.ZstdCompressor().compress(stream) for stream in streams]
    start = header[:15] + bytes([len(packed)]) + struct.pack("<I12x", 32 + len(records)) + records
    table = b"".join(struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True))
    path.write_bytes(start + table + b"".join(packed))


def record(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content


def covariances(cloud: GaussianCloud) -> np.ndarray:
    axes = rotation_matrices(cloud.quats_wxyz.astype(np.float64)) * np.exp(cloud.log_scales)[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_values_come_back_within_their_quantum(
    make_cloud: Make, tmp_path: Path, version: int, degree: int
) -> None:
    cloud = make_cloud(200, degree)
    write_spz(tmp_path / "a.spz", cloud, version)
    assert importer_for(tmp_path / "a.spz").name == "spz"
    back = importer_for(tmp_path / "a.spz").read(tmp_path / "a.spz")
    difference(back, cloud).assert_below(
        position=0.501 / 4096,
        # Version 2 leaves w to be what is missing to 1, which is loose near w = 0.
        rotation_degrees=12.0 if version == 2 else 0.3,
        log_scale=0.501 / 16,
        opacity=0.501 / 255,
        sh=0.501 / 255 / 0.15,
    )


def test_spz_higher_harmonics_are_dropped_with_warning(make_cloud: Make, tmp_path: Path) -> None:
    cloud = make_cloud(10, 3)
    header, streams = pack(cloud, 3, degree=4)
    streams[5] = b"".join(streams[5][45 * i : 45 * (i + 1)] + bytes(27) for i in range(10))
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + b"".join(streams)))
    gaussians, report = read_scene(tmp_path / "a.spz")
    assert gaussians.sh_degree == 3
    np.testing.assert_allclose(gaussians.sh[:, 1:], cloud.sh[:, 1:], atol=0.501 / 128)
    assert any("degree 4 were left out" in note for note in report.notes)


@pytest.mark.parametrize("version", [3, 4])
def test_damaged_files_are_refused(make_cloud: Make, tmp_path: Path, version: int) -> None:
    path = tmp_path / "a.spz"
    write_spz(path, make_cloud(100, 1), version)
    whole = path.read_bytes()
    for cut in (5, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(SceneFileError, match=r"a\.spz: is (damaged|truncated)"):
            read_scene(path)


def test_spz_oversized_header_is_refused(make_cloud: Make, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    header, _ = pack(make_cloud(1), 3)
    path.write_bytes(gzip.compress(header[:8] + struct.pack("<I", 2**31) + header[12:] + bytes(50)))
    with pytest.raises(SceneFileError, match="is truncated; not all of its 2147483648 Gaussians"):
        read_scene(path)
    for version in (1, 5):
        path.write_bytes(gzip.compress(header[:4] + struct.pack("<I", version) + header[8:]))
        with pytest.raises(SceneFileError, match=f"is SPZ version {version}; versions 2, 3 and 4"):
            read_scene(path)
    path.write_bytes(gzip.compress(b"hello" * 10))
    with pytest.raises(SceneFileError, match="is gzip, but holds no SPZ"):
        read_scene(path)
    path.write_bytes(gzip.compress(header[:12] + b"\x09" + header[13:]))
    with pytest.raises(SceneFileError, match="harmonics of degree 9"):
        read_scene(path)


RIGHT_DOWN_FRONT = np.eye(3)
RIGHT_UP_FRONT = np.diag([1, -1, 1])
RIGHT_FRONT_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
RIGHT_BACK_DOWN = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(
    ("number", "world_from_file"),
    [(6, RIGHT_DOWN_FRONT), (8, RIGHT_UP_FRONT), (12, RIGHT_FRONT_UP), (14, RIGHT_BACK_DOWN)],
)
def test_file_in_another_frame_is_turned(
    make_cloud: Make, tmp_path: Path, version: int, number: int, world_from_file: np.ndarray
) -> None:
    path, cloud = tmp_path / "a.spz", make_cloud(50, 3)
    write_spz(path, cloud, version)
    plain = importer_for(path).read(path)
    file_from_plain = np.diag([1, -1, -1])  # what the same numbers mean without a record
    turn = world_from_file @ file_from_plain
    records = record(0x12345678, b"else") + record(0xADBE0003, struct.pack("<I", number))
    write_spz(path, cloud, version, flags=2, records=records)
    turned = importer_for(path).read(path)
    np.testing.assert_allclose(turned.means_world, plain.means_world @ turn.T, atol=1e-6)
    np.testing.assert_allclose(covariances(turned), turn @ covariances(plain) @ turn.T, atol=1e-7)
    before, after = (
        np.einsum("k,nkc->nc", sh_basis(direction, 3), each.sh)
        for direction, each in ((DIRECTION, plain), (turn @ DIRECTION, turned))
    )
    np.testing.assert_allclose(after, before, atol=1e-5)
    _, report = read_scene(path)
    assert any("0x12345678" in note for note in report.notes)


@pytest.mark.parametrize("version", [3, 4])
def test_unknown_frame_is_refused(make_cloud: Make, tmp_path: Path, version: int) -> None:
    path = tmp_path / "a.spz"
    write_spz(path, make_cloud(5), version, flags=2, records=record(0xADBE0003, struct.pack("<I", 17)))
    with pytest.raises(SceneFileError, match="coordinate system that is not known"):
        read_scene(path)


def test_finest_of_levels_is_read_with_whole_opacities(make_cloud: Make, tmp_path: Path) -> None:
    path, leaves, coarse = tmp_path / "a.spz", make_cloud(17_000, 1), make_cloud(100, 1, seed=1)
    # as Spark writes a tree: coarser Gaussians among the others, and half of each opacity
    half = 0.5 / (1.0 + np.exp(-leaves.opacity_logits))
    halved = replace(leaves, opacity_logits=np.log(half / (1.0 - half)))
    both = concatenate_rows([coarse, halved])
    counts = np.concatenate([np.full(100, 200), np.zeros(17_000)]).astype("<u2")
    starts = np.concatenate([100 + 200 * np.arange(100), np.zeros(17_000)]).astype("<u4")
    write_spz(path, both, 3, flags=0x80, tree=counts.tobytes() + starts.tobytes())
    difference(importer_for(path).read(path), leaves).assert_below(
        position=0.501 / 4096, rotation_degrees=0.3, log_scale=0.501 / 16, opacity=1.01 / 255, sh=0.015
    )
    scene, report = read_scene(path)
    assert len(scene) == 17_000
    assert any("17,000 of 17,100" in note for note in report.notes)
    write_spz(path, both, 3, flags=0x80, tree=counts.tobytes()[:-1])
    with pytest.raises(SceneFileError, match="is truncated"):
        read_scene(path)


@pytest.mark.real
def test_spz_trained_scene_agrees_with_ply(splats: Path) -> None:
    spz, ply = splats / "biker.spz", splats / "biker.ply"
    a, b = importer_for(spz).read(spz), read_ply_cloud(ply)
    assert len(a.means_world) == 152746
    # Both were quantised from the same scene, each in its own way; SPZ ends at ln s = -10.
    b = replace(b, log_scales=np.maximum(b.log_scales, -10.0))
    difference(a, b).assert_below(
        position=1.3e-4, rotation_degrees=0.2, log_scale=0.032, opacity=0.001, sh=0.0132
    )
