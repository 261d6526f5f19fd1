"""What formats of few bits clip of a scene is told before it is written, and only then."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.files import dropped_on_export, export_scene, read_scene, spz
from octasplat.engine.gaussians.model import FlatGaussians

Make = Callable[..., FlatGaussians]
NAMES = ("a.ply", "a.splat", "a.spz", "a.sog", "a.compressed.ply", "a.splats.glb", "a.glb", "a.usdz", "a.obj")


def losses(scene: FlatGaussians, name: str) -> str:
    return " ".join(dropped_on_export(replace(scene, sh=scene.sh[:, :1]), [Path(name)]))


def with_sizes(scene: FlatGaussians, low: float, high: float) -> FlatGaussians:
    sizes = np.random.default_rng(5).uniform(np.log(low), np.log(high), (len(scene), 2))
    return replace(scene, log_scales=sizes.astype(np.float32))


@pytest.mark.parametrize("name", NAMES)
def test_ordinary_scene_loses_nothing_by_ranges(make_gaussians: Make, name: str) -> None:
    assert losses(with_sizes(make_gaussians(500), 0.01, 1.0), name) == ""


@pytest.mark.parametrize(
    ("low", "high", "scale"),
    [(13_900.0, 323_000.0, "0.001"), (1e-7, 1e-6, "1e+03"), (1e3, 2e3, "0.1"), (1e-9, 1e-5, "1e+05")],
    ids=["micrometres", "tiny", "millimetres", "nanometres"],
)
def test_spz_tells_sizes_that_it_clips_and_the_scale_that_fits(
    make_gaussians: Make, tmp_path: Path, low: float, high: float, scale: str
) -> None:
    scene = with_sizes(make_gaussians(300), low, high)
    told = losses(scene, "a.spz")
    assert "300 of 300 Gaussians do not fit and will be clipped" in told
    assert f"octasplat transform --scale {scale} makes all of them fit" in told
    scaled = replace(
        scene,
        log_scales=(scene.log_scales + np.log(float(scale))).astype(np.float32),
        means_world=(scene.means_world * np.float32(scale)).astype(np.float32),
    )
    assert "do not fit" not in losses(scaled, "a.spz")
    export_scene(scaled, tmp_path / "a.spz")
    back = read_scene(tmp_path / "a.spz")[0].log_scales
    # A byte holds ln of a size in steps of 1/16; the two axes may change places.
    np.testing.assert_allclose(np.sort(back, axis=1), np.sort(scaled.log_scales, axis=1), atol=0.04)


@pytest.mark.parametrize("name", ["a.ply", "a.splat", "a.sog", "a.compressed.ply", "a.splats.glb"])
def test_scene_as_small_as_gaussians_are_thick_is_told(make_gaussians: Make, name: str) -> None:
    scene = with_sizes(make_gaussians(300), 1e-6, 1e-5)
    told = losses(scene, name)
    assert "1e-05 units thick, which is much for the size of 300 of 300" in told
    assert "octasplat transform --scale 1e+03" in told
    bigger = replace(scene, log_scales=(scene.log_scales + np.log(1e3)).astype(np.float32))
    assert "thick" not in losses(bigger, name)
    # some small ones do not matter in a scene of another size
    few = replace(bigger, log_scales=bigger.log_scales.copy())
    few.log_scales[:20] = np.log(1e-6)
    assert "thick" not in losses(few, name)


def test_spz_tells_more_gaussians_than_its_own_reader_takes(
    make_gaussians: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = with_sizes(make_gaussians(300), 0.01, 1.0)
    monkeypatch.setattr(spz, "MAX_READ", 300)
    assert losses(scene, "a.spz") == ""
    monkeypatch.setattr(spz, "MAX_READ", 299)
    assert "takes no SPZ of more than 299 Gaussians; this one has 300" in losses(scene, "a.spz")


def test_spz_tells_sizes_that_no_scale_makes_fit(make_gaussians: Make) -> None:
    told = losses(with_sizes(make_gaussians(300), 1e-8, 1e5), "a.spz")
    assert "do not fit and will be clipped." in told


@pytest.mark.parametrize("name", ["a.spz", "a.sog"])
def test_positions_coarser_than_gaussians_are_told(make_gaussians: Make, name: str) -> None:
    scene = with_sizes(make_gaussians(300), 0.05, 0.06)
    scene.means_world[:150, 1] += np.float32(5e6)
    assert "of 300 Gaussians; crop what lies far away" in losses(scene, name)
    assert losses(scene, "a.splats.glb") == ""


def test_compressed_ply_tells_positions_of_a_chunk_that_is_too_wide(make_gaussians: Make) -> None:
    scene = with_sizes(make_gaussians(200), 0.01, 0.02)
    scene.means_world[0] = 1e4
    assert "200 of 200 Gaussians" in losses(scene, "a.compressed.ply")


@pytest.mark.parametrize(("name", "limit"), [("a.spz", 1.0), ("a.compressed.ply", 4.0)])
def test_harmonics_beyond_the_range_are_told(make_gaussians: Make, name: str, limit: float) -> None:
    scene = with_sizes(make_gaussians(100, 1), 0.05, 0.5)
    scene.sh[:, 1:] = 0.9 * limit
    assert dropped_on_export(scene, [Path(name)]) == ()
    scene.sh[:40, 2, 1] = -1.5 * limit
    (told,) = dropped_on_export(scene, [Path(name)])
    assert f"up to {limit:g}; those of 40 of 100 Gaussians are larger" in told
