import mmap
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pycolmap
import pytest

import octasplat
from octasplat.engine.core.errors import DatasetError, OutputError
from octasplat.engine.dataset import Dataset, mapped_array
from octasplat.engine.dataset.mapped_array import MappedArray


def stamps(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


def opaque_fisheye() -> pycolmap.Camera:
    return pycolmap.Camera(
        model="OPENCV_FISHEYE", width=32, height=24, params=[30, 31, 16, 12, 0.01, 0, 0, 0]
    )


def test_dataset_cache_is_reused(tmp_path, make_scene, save_image):
    root = make_scene(tmp_path / "scene", cameras=[opaque_fisheye()])
    save_image(root / "masks/view_0.png.png", np.full((24, 32), 255, np.uint8))
    first: list[tuple[int, int]] = []
    Dataset.open(root, tmp_path / "cache", progress=lambda *step: first.append(step))
    assert first == [(1, 4), (2, 4), (3, 4), (4, 4)]
    written = stamps(tmp_path / "cache")
    assert set(written) == {"rgb.bin", "mask.bin", "pixels.json", "directions.bin", "directions.json"}
    second: list[tuple[int, int]] = []
    data = Dataset.open(root, tmp_path / "cache", masks="alpha", progress=lambda *step: second.append(step))
    assert second == []
    assert stamps(tmp_path / "cache") == written
    assert data.pixels(np.array([3]), np.array([7]), np.array([9]))[0].tolist() == [
        np.float32([9 / 255, 7 / 255, 3 / 255]).tolist()
    ]


def test_dataset_pixels_are_the_same_when_read_ahead(tmp_path, make_scene, monkeypatch):
    asked: list[tuple[int, int]] = []

    class Map(mmap.mmap):
        def madvise(self, _advice: int, start: int = 0, length: int = 0) -> None:
            asked.append((start, length))

    data = Dataset.open(make_scene(tmp_path / "scene", cameras=[opaque_fisheye()]), tmp_path / "cache")
    before = data.pixels(np.array([3]), np.array([7]), np.array([9]))[0]
    data.read_ahead(np.array([0, 3]))
    assert np.array_equal(before, data.pixels(np.array([3]), np.array([7]), np.array([9]))[0])
    plane = MappedArray(np.zeros(10_000, np.uint16), Map(-1, 20_000))
    plane.read_ahead(np.array([[10, 20], [5000, 6000]]))
    assert asked == [(0, 40), (8192, 12_000 - 8192)]  # whole pages from the first on
    monkeypatch.setattr(mapped_array, "_read_ahead_bytes", lambda: 3000)
    plane.read_ahead(np.array([[10, 20], [5000, 6000]]))
    assert len(asked) == 2


def test_dataset_cache_changed_photograph_invalidates(tmp_path, make_scene, save_image):
    root = make_scene(tmp_path / "scene")
    before = Dataset.open(root, tmp_path / "cache")
    save_image(root / "images/view_1.png", np.full((24, 32, 3), 200, np.uint8))
    after = Dataset.open(root, tmp_path / "cache")
    assert (np.rint(after.view_image(1)[0] * 255) == 200).all()
    # Whoever still holds the earlier cache keeps on seeing it whole.
    assert np.rint(before.view_image(1)[0] * 255)[0, 0].tolist() == [0, 0, 1]


def test_dataset_cache_changed_settings_or_masks_invalidate(tmp_path, make_scene, save_image):
    root = make_scene(tmp_path / "scene")
    Dataset.open(root, tmp_path / "cache")
    small = Dataset.open(root, tmp_path / "cache", max_side=8)
    assert small.view_image(0)[0].shape == (6, 8, 3)
    save_image(root / "masks/view_0.png.png", np.zeros((24, 32), np.uint8))
    masked = Dataset.open(root, tmp_path / "cache", max_side=8)
    assert (masked.view_image(0)[2] == 0).all()
    (root / "masks/view_0.png.png").unlink()
    assert not Dataset.open(root, tmp_path / "cache", max_side=8).has_masks
    assert not (tmp_path / "cache/mask.bin").exists()


def test_dataset_cache_changed_camera_gives_new_rays(tmp_path, make_scene):
    root = make_scene(tmp_path / "scene", cameras=[opaque_fisheye()])
    before = Dataset.open(root, tmp_path / "cache").view_rays(0).directions_world
    other = opaque_fisheye()
    other.params = [25, 25, 16, 12, 0, 0, 0, 0]
    make_scene(root, cameras=[other])
    assert np.abs(Dataset.open(root, tmp_path / "cache").view_rays(0).directions_world - before).max() > 0.01


@pytest.mark.parametrize("name", ["rgb.bin", "mask.bin", "pixels.json", "directions.bin", "directions.json"])
def test_dataset_cache_damaged_is_rebuilt(tmp_path, make_scene, save_image, name):
    root = make_scene(tmp_path / "scene", cameras=[opaque_fisheye()])
    save_image(root / "masks/view_0.png.png", np.full((24, 32), 255, np.uint8))
    before = Dataset.open(root, tmp_path / "cache")
    expected = before.view_image(2), before.view_rays(2)
    path = tmp_path / "cache" / name
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(content[: len(content) // 2])
    after = Dataset.open(root, tmp_path / "cache")
    np.testing.assert_array_equal(after.view_image(2)[0], expected[0][0])
    np.testing.assert_array_equal(after.view_rays(2).directions_world, expected[1].directions_world)


def test_dataset_cache_truncated_photograph_leaves_no_files(tmp_path, make_scene, capfd):
    root = make_scene(tmp_path / "scene")
    path = root / "images/view_2.png"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(DatasetError, match=r"view_2\.png is damaged"):
        Dataset.open(root, tmp_path / "cache")
    assert list((tmp_path / "cache").iterdir()) == []


def test_dataset_cache_cancelled_leaves_no_files(tmp_path, make_scene):
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    root = make_scene(tmp_path / "scene")
    with pytest.raises(KeyboardInterrupt):
        Dataset.open(root, tmp_path / "cache", progress=stop)
    assert list((tmp_path / "cache").iterdir()) == []
    Dataset.open(root, tmp_path / "cache")


def test_dataset_cache_independent_of_threads(tmp_path, make_scene):
    root = make_scene(tmp_path / "scene")
    for threads in (1, 3):
        Dataset.open(root, tmp_path / f"cache_{threads}", max_side=20, threads=threads)
    assert (tmp_path / "cache_1/rgb.bin").read_bytes() == (tmp_path / "cache_3/rgb.bin").read_bytes()


def test_dataset_cache_unwritable_folder_is_named(tmp_path, make_scene):
    root = make_scene(tmp_path / "scene", cameras=[opaque_fisheye()])
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="file/cache"):
        Dataset.open(root, tmp_path / "file/cache")


def test_dataset_cache_other_scene_with_same_metadata_invalidates(tmp_path, make_scene, coded):
    one = make_scene(tmp_path / "one")
    two = make_scene(tmp_path / "two", images=[(f"view_{i}.png", 0, coded(32, 24, 90 + i)) for i in range(4)])
    for i in range(4):
        stat = (one / f"images/view_{i}.png").stat()
        os.utime(two / f"images/view_{i}.png", ns=(stat.st_atime_ns, stat.st_mtime_ns))
    Dataset.open(one, tmp_path / "cache")
    data = Dataset.open(two, tmp_path / "cache")
    assert round(float(data.view_image(0)[0][0, 0, 2]) * 255) == 90


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_photographs_do_not_fill_memory(tmp_path, make_scene):
    # 12 x 9 MP: a cache of 324 MB. Private memory is what cannot be given back under pressure.
    camera = pycolmap.Camera(model="PINHOLE", width=3000, height=3000, params=[3000, 3000, 1500, 1500])
    image = np.zeros((3000, 3000, 3), np.uint8)
    image[..., 0] = np.arange(3000) // 12
    root = make_scene(
        tmp_path / "scene", cameras=[camera], images=[(f"{i}.jpg", 0, image) for i in range(12)]
    )
    script = textwrap.dedent("""
        import sys
        from pathlib import Path
        import numpy as np
        from octasplat.engine.dataset import Dataset

        def private_mb():
            lines = Path("/proc/self/status").read_text().splitlines()
            return int(next(line for line in lines if line.startswith("RssAnon")).split()[1]) / 1024

        start = private_mb()
        data = Dataset.open(Path(sys.argv[1]), Path(sys.argv[2]), threads=1)
        rng = np.random.default_rng(0)
        for _ in range(50):
            pixels = data.sample_pixels(rng, 8192)
            data.rays(*pixels)
            data.pixels(*pixels)
        print(private_mb() - start)
    """)
    run = subprocess.run(
        [sys.executable, "-c", script, str(root), str(tmp_path / "cache")],
        capture_output=True, text=True, check=True, cwd=Path(octasplat.__file__).parents[2],
    )  # fmt: skip
    assert (tmp_path / "cache/rgb.bin").stat().st_size == 12 * 3000 * 3000 * 3
    assert float(run.stdout) < 150
