import struct
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files import importer_for, read_scene


def row(scale: tuple[float, float, float] = (0.5, 0.25, 1e-5)) -> bytes:
    return struct.pack("<6f8B", 1.0, -2.0, 3.5, *scale, 0, 128, 255, 51, 128, 128, 0, 128)


def test_splat_known_bytes_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(row() + row((1e-5, 2.0, 3.0)))
    gaussians, report = read_scene(tmp_path / "a.splat")
    assert (report.count, report.sh_degree, report.flattened) == (2, 0, 0)
    np.testing.assert_array_equal(gaussians.means_world, [[1, -2, 3.5]] * 2)
    np.testing.assert_allclose(gaussians.scales, [[0.5, 0.25], [2, 3]], rtol=1e-6)
    np.testing.assert_allclose(gaussians.opacities, 0.2, atol=1e-7)
    np.testing.assert_allclose(gaussians.base_rgb_srgb[0], [0, 128 / 255, 1], atol=1e-6)
    # Half a turn about y: the third axis, which is flat in the first row, becomes -z.
    np.testing.assert_allclose(gaussians.rotations[0, :, 0], [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(gaussians.rotations[1, :, 0], [-1, 0, 0], atol=1e-6)


def test_splat_whose_first_number_begins_as_gzip_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(b"\x1f\x8b\x40\x3f" + row()[4:])
    np.testing.assert_allclose(
        read_scene(tmp_path / "a.splat")[0].means_world, [[0.75212, -2, 3.5]], atol=1e-5
    )


def test_bytes_at_the_ends_are_no_infinite_logits(tmp_path: Path) -> None:
    data = bytearray(row() * 2)
    data[27], data[32 + 27] = 0, 255
    (tmp_path / "a.splat").write_bytes(data)
    gaussians, report = read_scene(tmp_path / "a.splat")
    assert report.saturated == 0
    np.testing.assert_allclose(gaussians.opacities, [0.25 / 255, 1 - 0.25 / 255], atol=1e-6)


def test_splat_invalid_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(row()[:-1])
    with pytest.raises(SceneFileError, match=r"a\.splat: is no \.splat, .*31 bytes"):
        read_scene(path)
    path.write_bytes(b"")
    with pytest.raises(SceneFileError, match="holds no Gaussians"):
        read_scene(path)
    path.write_bytes(row((-1.0, 1.0, 1.0)) + row())
    with pytest.raises(SceneFileError, match="1 of 2 Gaussians have no finite scale"):
        read_scene(path)
    assert len(read_scene(path, drop_invalid=True)[0]) == 1


@pytest.mark.real
def test_splat_of_trained_scene_is_read(splats: Path) -> None:
    path = splats / "nerf_chair.splat"
    assert importer_for(path).name == "splat"
    gaussians, report = read_scene(path)
    assert report.count == path.stat().st_size // 32 == 111650
    assert gaussians.is_finite()
    assert 0.0 < report.median_thickness < 0.2 < report.max_thickness <= 1.0
    assert 0 < report.thick < report.flattened < report.count
