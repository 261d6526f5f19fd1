"""Files of many Gaussians are written and read in little more memory than the scene itself takes."""

import gc
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.files import ExportOptions, dropped_on_export, export_scene, read_scene
from octasplat.engine.gaussians import flattening
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import row_arrays
from tests.support.daily import some_daily

COUNTS = (50_000, 150_000)
"""Between these the memory may grow by no more than what is stated for each Gaussian."""
NOISE_BYTES = 9
"""As blocks are not let go at once."""
ORDER_BYTES = 28
"""Of what is sorted in space: numbers of 32 bits, one coordinate and the places that a sort returns."""
WRITTEN = {
    "a.ply": 0,
    "a.splat": 0,
    "a.spz": 4,  # the lesser scale of each
    "a.splats.glb": 0,
    "a.compressed.ply": ORDER_BYTES,
    "a.glb": ORDER_BYTES + 12,  # a 64th of them at a time
    "a.mesh.ply": 9,  # which have an octagon
    "tiles/tileset.json": 60,  # the tree of neighbors, and who is the partner of whom; levels are in files
}
READ = {
    "a.ply": 1,  # whether each is valid
    "a.splat": 5,  # and the thickness of each, if it is not flat
    "a.spz": 5,
    "a.splats.glb": 1,
    "a.compressed.ply": 5,
    "a.glb": 9,  # numbers of the octagons, and where each belongs
    "a.mesh.ply": 9,
}


def random_scene(count: int) -> FlatGaussians:
    random = np.random.default_rng(0)

    def normal(*shape: int) -> np.ndarray:
        return random.standard_normal(shape, dtype=np.float32)

    return FlatGaussians(
        normal(count, 3), normal(count, 4), normal(count, 2) - 4, normal(count) + 1, normal(count, 4, 3) / 8
    )


def scene_bytes(scene: FlatGaussians) -> int:
    return sum(array.nbytes for array in row_arrays(scene).values())


def peak_bytes(step: Callable[[], object]) -> int:
    """The most memory that a step has beyond what there was before; what it returns is let go after that."""
    gc.collect()
    tracemalloc.start()
    try:
        step()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def growth(peaks: list[int]) -> float:
    return (peaks[1] - peaks[0]) / (COUNTS[1] - COUNTS[0])


@pytest.mark.parametrize("name", some_daily(WRITTEN, {"a.ply", "a.glb", "a.spz"}))
def test_writing_takes_no_more_memory_for_more_gaussians(name: str, tmp_path: Path) -> None:
    scenes = [random_scene(count) for count in COUNTS]
    export_scene(random_scene(100), tmp_path / name)  # what is loaded once
    peaks = [peak_bytes(lambda: export_scene(scene, tmp_path / name)) for scene in scenes]  # noqa: B023
    assert growth(peaks) <= WRITTEN[name] + NOISE_BYTES


def test_leaving_faint_gaussians_out_takes_no_copy_of_a_large_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, options, peaks = tmp_path / "a.splats.glb", ExportOptions(min_opacity=0.5), []
    export_scene(random_scene(100), path, options)
    for count in COUNTS:
        scene = random_scene(count)
        monkeypatch.setattr(flattening, "MANY_BYTES", scene_bytes(scene) // 2)
        peaks.append(peak_bytes(lambda: export_scene(scene, path, options)))  # noqa: B023
    assert growth(peaks) <= 10 + NOISE_BYTES  # which are left
    scene = random_scene(COUNTS[1])
    left = scene.select(scene.opacities >= 0.5)
    np.testing.assert_array_equal(read_scene(path)[0].means_world, left.means_world)
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", some_daily(READ, {"a.mesh.ply", "a.spz"}))
def test_reading_takes_no_more_memory_than_the_scene(name: str, tmp_path: Path) -> None:
    beyond = []
    for count in COUNTS:
        # one chunk, as else what is read at a time grows until it is a block
        export_scene(random_scene(count), tmp_path / name, ExportOptions(chunks=1))
        found = scene_bytes(read_scene(tmp_path / name)[0])
        beyond.append(peak_bytes(lambda: read_scene(tmp_path / name)) - found)
    assert growth(beyond) <= READ[name] + NOISE_BYTES


def test_large_scenes_are_read_into_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, place = tmp_path / "a.ply", tmp_path / "place"
    place.mkdir()
    peaks = []
    for count in COUNTS:
        export_scene(random_scene(count), path)
        monkeypatch.setattr(flattening, "MANY_BYTES", scene_bytes(random_scene(count)))
        peaks.append(peak_bytes(lambda: read_scene(path, folder=place)))
    assert growth(peaks) <= READ[path.name] + NOISE_BYTES
    expected = row_arrays(read_scene(path)[0])
    # Where no file can be made the scene is in memory.
    for folder in (place, tmp_path / "none", Path("/proc")):
        found = row_arrays(read_scene(path, folder=folder)[0])
        for name, array in expected.items():
            np.testing.assert_array_equal(found[name], array)
    assert list(place.iterdir()) == []


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", some_daily(["a.spz", "a.compressed.ply", "a.sog"], {"a.spz"}))
def test_losses_are_told_in_little_memory(name: str, tmp_path: Path) -> None:
    scenes = [random_scene(count) for count in COUNTS]
    peaks = [peak_bytes(lambda: dropped_on_export(scene, [tmp_path / name])) for scene in scenes]  # noqa: B023
    assert growth(peaks) <= ORDER_BYTES


@pytest.mark.exhaustive
def test_version_4_of_spz_takes_what_it_compresses_to(tmp_path: Path) -> None:
    options = ExportOptions(spz_version=4)
    scenes = [random_scene(count) for count in COUNTS]
    peaks = [peak_bytes(lambda: export_scene(scene, tmp_path / "a.spz", options)) for scene in scenes]  # noqa: B023
    assert growth(peaks) <= 12 + NOISE_BYTES  # as much as harmonics might become
