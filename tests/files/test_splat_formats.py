"""Formats of the splat family: written, read again and compared, with half a step of each as tolerance."""

import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files import ExportOptions, export_scene, exporter_for, read_scene
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians

Make = Callable[[int, int], FlatGaussians]
FORMATS = ("scene.ply", "scene.splat", "scene.spz", "scene.splats.glb")


@pytest.fixture
def make_flat() -> Make:
    def make(count: int, sh_degree: int) -> FlatGaussians:
        random = np.random.default_rng(count + sh_degree)

        def uniform(low: float, high: float, *shape: int) -> np.ndarray:
            return random.uniform(low, high, shape).astype(np.float32)

        return FlatGaussians(
            means_world=uniform(-4, 4, count, 3),
            quats_wxyz=random.standard_normal((count, 4)).astype(np.float32) * 2,
            log_scales=uniform(-6, 0, count, 2),
            opacity_logits=uniform(-5, 5, count),
            sh=np.concatenate(
                [uniform(-1.7, 1.7, count, 1, 3), uniform(-0.9, 0.9, count, (sh_degree + 1) ** 2 - 1, 3)],
                axis=1,
            ),
        )

    return make


def degrees_apart(a: FlatGaussians, b: FlatGaussians) -> float:
    """Largest angle between frames; the columns may differ in sign."""
    ra, rb = (rotation_matrices(g.quats_wxyz.astype(np.float64)) for g in (a, b))
    cosines = np.abs(np.einsum("nij,nij->nj", ra, rb))
    return float(np.degrees(np.arccos(np.clip(cosines, -1, 1))).max())


@pytest.mark.parametrize(
    ("name", "format"),
    [
        ("a.splat", "splat"),
        ("a.spz", "spz"),
        ("a.SOG", "sog"),
        ("a.splats.glb", "khr-glb"),
        ("splats.glb", "khr-glb"),
        ("a.glb", "glb"),
        ("a.usdz", "usd"),
        ("a.usda", "usd"),
    ],
)
def test_splat_format_follows_suffix(name: str, format: str) -> None:
    assert exporter_for(Path(name)).name == format


@pytest.mark.parametrize(
    ("name", "position", "degrees", "log_scale", "opacity", "constant", "rest"),
    [
        ("scene.ply", 0, 1e-3, 0, 0, 0, 0),
        ("scene.splat", 0, 0.9, 1e-6, 0.502 / 255, 0.502 / 255 / 0.2820948, None),
        ("scene.spz", 0.501 / 4096, 0.3, 0.501 / 16, 0.502 / 255, 0.502 / 255 / 0.15, 0.502 / 8),
        ("scene.splats.glb", 0, 1e-3, 2e-6, 1e-7, 0, 0),
    ],
)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_values_come_back_within_half_a_step(
    make_flat: Make,
    tmp_path: Path,
    name: str,
    position: float,
    degrees: float,
    log_scale: float,
    opacity: float,
    constant: float,
    rest: float | None,
    degree: int,
) -> None:
    scene = make_flat(2000, degree)
    export_scene(scene, tmp_path / name)
    back, report = read_scene(tmp_path / name)
    assert report.count == 2000
    assert back.sh_degree == (degree if rest is not None else 0)
    if name != "scene.spz":  # whose scales end at exp(-10), above ours
        assert report.flattened == 0
    assert np.abs(back.means_world - scene.means_world).max() <= position
    assert degrees_apart(back, scene) <= degrees
    assert np.abs(back.log_scales - scene.log_scales).max() <= log_scale
    assert np.abs(back.opacities - scene.opacities).max() <= opacity
    assert np.abs(back.sh[:, 0] - scene.sh[:, 0]).max() <= constant
    if rest is not None and degree:
        assert np.abs(back.sh[:, 1:] - scene.sh[:, 1:]).max() <= rest


@pytest.mark.parametrize("name", ["scene.ply", "scene.spz"])
def test_splat_formats_round_trip_bytes(make_flat: Make, tmp_path: Path, name: str) -> None:
    export_scene(make_flat(500, 2), tmp_path / name)
    again = tmp_path / "again" / name
    export_scene(read_scene(tmp_path / name)[0], again)
    assert again.read_bytes() == (tmp_path / name).read_bytes()


@pytest.mark.parametrize("name", [*FORMATS, "scene.usda", "scene.sog"])
def test_failed_splat_export_leaves_no_file(make_flat: Make, tmp_path: Path, name: str) -> None:
    scene = make_flat(5, 0)
    broken = scene.copy()
    broken.log_scales[1, 1] = np.nan
    for bad, message in ((scene.select(np.arange(0)), "there are no Gaussians"), (broken, "not finite")):
        with pytest.raises(SceneFileError, match=message) as caught:
            export_scene(bad, tmp_path / name)
        assert name in str(caught.value)
    scene.opacity_logits[:] = -1.0
    with pytest.raises(SceneFileError, match="all 5 Gaussians are below min_opacity"):
        export_scene(scene, tmp_path / name, ExportOptions(min_opacity=0.9))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", FORMATS)
def test_splat_formats_own_files_stay_flat(make_flat: Make, tmp_path: Path, name: str) -> None:
    export_scene(make_flat(50, 0), tmp_path / name)
    assert read_scene(tmp_path / name)[1].flattened == 0


@pytest.mark.parametrize("name", FORMATS)
def test_min_opacity_leaves_faint_gaussians_out(make_flat: Make, tmp_path: Path, name: str) -> None:
    scene = make_flat(300, 0)
    bright = scene.opacities >= 0.5
    assert 0 < bright.sum() < 300
    export_scene(scene, tmp_path / name, ExportOptions(min_opacity=0.5))
    back, _ = read_scene(tmp_path / name)
    np.testing.assert_allclose(back.means_world, scene.means_world[bright], atol=1.3e-4)


def test_splat_quaternion_component_of_one_fits_byte(make_flat: Make, tmp_path: Path) -> None:
    scene = make_flat(4, 0)
    scene.quats_wxyz[:] = np.eye(4, dtype=np.float32)
    export_scene(scene, tmp_path / "a.splat")
    assert degrees_apart(read_scene(tmp_path / "a.splat")[0], scene) == 0.0


def test_spz_gives_small_scenes_more_bits_and_large_ones_fewer(make_flat: Make, tmp_path: Path) -> None:
    scene = make_flat(100, 0)
    scene.log_scales[:] = np.log(1e-4)
    export_scene(scene, tmp_path / "fine.spz")
    fine, _ = read_scene(tmp_path / "fine.spz")
    assert np.abs(fine.means_world - scene.means_world).max() < 1e-4 / 8
    scene.means_world *= 100_000
    export_scene(scene, tmp_path / "wide.spz")
    wide, _ = read_scene(tmp_path / "wide.spz")
    np.testing.assert_allclose(wide.means_world, scene.means_world, atol=0.04)
    scene.means_world[0] = 1e8
    with pytest.raises(SceneFileError, match="SPZ holds positions up to"):
        export_scene(scene, tmp_path / "far.spz")


@pytest.mark.parametrize("name", ["scene.splat", "scene.splats.glb", "scene.usda"])
def test_scales_beyond_float32_are_refused(make_flat: Make, tmp_path: Path, name: str) -> None:
    scene = make_flat(5, 0)
    scene.log_scales[3] = 100.0
    with pytest.raises(SceneFileError, match="too large for float32"):
        export_scene(scene, tmp_path / name)
    assert not (tmp_path / name).exists()


def test_spz_versions_3_and_4_hold_same_scene(make_flat: Make, tmp_path: Path) -> None:
    scene = make_flat(1000, 3)
    for version in (3, 4):
        export_scene(scene, tmp_path / f"{version}.spz", ExportOptions(spz_version=version))
    assert (tmp_path / "4.spz").read_bytes()[:8] == b"NGSP\x04\0\0\0"
    a, b = (read_scene(tmp_path / f"{version}.spz")[0] for version in (3, 4))
    for name in ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_sog_missing_converter_is_named(
    make_flat: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OCTASPLAT_SPLAT_TRANSFORM", str(tmp_path / "nowhere"))
    with pytest.raises(
        SceneFileError, match=r"a\.sog: needs the program splat-transform; .*@playcanvas/splat-transform"
    ):
        export_scene(make_flat(3, 0), tmp_path / "a.sog")
    assert not (tmp_path / "a.sog").exists()


@pytest.mark.parametrize(
    ("script", "message"), [("echo out of order >&2; exit 3", "failed .out of order"), ("exit 0", "failed")]
)
def test_sog_converter_error_is_quoted(
    make_flat: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, message: str
) -> None:
    program = tmp_path / "converter"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("OCTASPLAT_SPLAT_TRANSFORM", os.fspath(program))
    with pytest.raises(SceneFileError, match=rf"a\.sog: converter {message}"):
        export_scene(make_flat(3, 0), tmp_path / "a.sog")
    assert not (tmp_path / "a.sog").exists()


@pytest.mark.parametrize("name", ["a.sog", "a.spz"])
def test_what_is_on_the_way_lies_beside_the_file(
    make_flat: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """As the folder for temporary files is often in memory, and small."""
    program = tmp_path / "converter"
    program.write_text('#!/bin/sh\nfor last; do :; done\necho packed > "$last"\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("OCTASPLAT_SPLAT_TRANSFORM", os.fspath(program))
    monkeypatch.setattr(tempfile, "tempdir", os.fspath(tmp_path / "none"))
    export_scene(make_flat(3, 1), tmp_path / "new" / name, ExportOptions(spz_version=4))
    assert [file.name for file in (tmp_path / "new").iterdir()] == [name]
