import json

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset import Dataset


def all_pixels(data: Dataset, view: int):
    y, x = np.mgrid[0 : data.views[view].height_px, 0 : data.views[view].width_px]
    return np.full(y.size, view), y.ravel(), x.ravel()


def mixed_scene(make_scene, root, coded):
    """Pinhole and distorted cameras of several sizes, one of them with pixels outside its field of view."""
    cameras = [
        pycolmap.Camera(model="PINHOLE", width=32, height=24, params=[30, 31, 11, 12]),
        pycolmap.Camera(model="OPENCV", width=40, height=20, params=[30, 31, 20, 10, -0.1, 0.01, 0, 0.001]),
        pycolmap.Camera(model="OPENCV_FISHEYE", width=30, height=30, params=[11, 11, 15, 15, 0, 0, 0, 0]),
        pycolmap.Camera(model="SIMPLE_RADIAL", width=20, height=40, params=[30, 10, 20, 0.05]),
    ]
    images = [(f"{i}.png", i % 4, coded(cameras[i % 4].width, cameras[i % 4].height, i)) for i in range(8)]
    return make_scene(root, cameras=cameras, images=images)


@pytest.mark.parametrize("max_table_bytes", [1 << 30, 12 * 1000, 0], ids=["tables", "one table", "direct"])
def test_rays_and_pixels_of_a_mixed_scene(tmp_path, make_scene, coded, max_table_bytes):
    root = mixed_scene(make_scene, tmp_path / "scene", coded)
    data = Dataset.open(root, tmp_path / "cache", max_table_bytes=max_table_bytes)
    assert "1 cameras (OPENCV_FISHEYE) cannot un-project" in data.warnings[0]
    model = pycolmap.Reconstruction(str(root / "sparse/0"))
    rng = np.random.default_rng(0)
    view = rng.integers(0, 8, 2000)
    sizes = np.array([[v.width_px, v.height_px] for v in data.views])[view]
    x, y = (rng.random(2000) * sizes[:, 0]).astype(int), (rng.random(2000) * sizes[:, 1]).astype(int)
    rays = data.rays(view, y, x)
    origins, directions = rays.origins_world, rays.directions_world
    rgb, alpha, weight = data.pixels(view, y, x)
    assert origins.dtype == directions.dtype == rgb.dtype == alpha.dtype == weight.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=2e-7)
    np.testing.assert_array_equal(np.rint(rgb * 255), np.stack([x, y, view], axis=1))
    assert (alpha == 1).all()
    images = {image.name: image for image in model.images.values()}
    for i in range(2000):
        image = images[data.views[view[i]].name]
        np.testing.assert_allclose(origins[i], image.projection_center(), atol=1e-6)
        seen = image.cam_from_world() * (origins[i].astype(float) + 3.0 * directions[i])
        radius = np.hypot(x[i] + 0.5 - 15, y[i] + 0.5 - 15)
        if image.camera_id == 3 and radius / 11 >= np.pi / 2:
            assert weight[i] == 0
            np.testing.assert_allclose(directions[i], image.viewing_direction(), atol=1e-6)
        else:
            assert weight[i] == 1
            projected = model.cameras[image.camera_id].img_from_cam(seen)
            np.testing.assert_allclose(projected, [x[i] + 0.5, y[i] + 0.5], atol=1e-3)


def test_tables_and_direct_rays_agree(tmp_path, make_scene, coded):
    root = mixed_scene(make_scene, tmp_path / "scene", coded)
    tabled = Dataset.open(root, tmp_path / "cache")
    direct = Dataset.open(root, tmp_path / "cache", max_table_bytes=0)
    for view in range(8):
        np.testing.assert_allclose(
            tabled.view_rays(view).directions_world, direct.view_rays(view).directions_world, atol=2e-7
        )
        np.testing.assert_array_equal(tabled.view_image(view)[2], direct.view_image(view)[2])


def test_dataset_view_equals_sampled_pixels(tmp_path, make_scene, coded):
    data = Dataset.open(mixed_scene(make_scene, tmp_path / "scene", coded), tmp_path / "cache")
    assert len(data.views) >= 3
    for index, view in enumerate(data.views):
        shape = (view.height_px, view.width_px)
        pixels = all_pixels(data, index)
        whole, single = data.view_rays(index), data.rays(*pixels)
        np.testing.assert_array_equal(whole.directions_world.reshape(-1, 3), single.directions_world)
        assert (single.origins_world == whole.origin_world).all()
        rgb, alpha, weight = data.view_image(index)
        assert rgb.shape == (*shape, 3) and alpha.shape == weight.shape == shape
        for whole, single in zip((rgb.reshape(-1, 3), alpha, weight), data.pixels(*pixels), strict=True):
            np.testing.assert_array_equal(whole.reshape(single.shape), single)


def test_pixel_outside_view_is_refused(tmp_path, make_scene):
    data = Dataset.open(make_scene(tmp_path / "scene"), tmp_path / "cache")
    for view, y, x in [(4, 0, 0), (-1, 0, 0), (0, 24, 0), (0, 0, 32), (0, -1, 0)]:
        arrays = tuple(np.array([0, value]) for value in (view, y, x))
        with pytest.raises(IndexError, match=f"view {view}, y {y}, x {x}"):
            data.pixels(*arrays)
        with pytest.raises(IndexError, match=f"view {view}, y {y}, x {x}"):
            data.rays(*arrays)
    for view in (-1, 4):
        with pytest.raises(IndexError):
            data.view_image(view)


def test_samples_are_uniform_over_training_pixels(tmp_path, make_scene, coded):
    root = mixed_scene(make_scene, tmp_path / "scene", coded)
    data = Dataset.open(root, tmp_path / "cache")
    assert data.test_indices.tolist() == [0]
    assert data.train_pixel_count == 768 + 2 * (800 + 900 + 800)
    view, y, x = data.sample_pixels(np.random.default_rng(5), 200_000)
    data.pixels(view, y, x)  # they all exist
    counts = np.bincount(view, minlength=8)
    sizes = np.array([0, *(v.width_px * v.height_px for v in data.views[1:])])
    np.testing.assert_allclose(counts / counts.sum(), sizes / sizes.sum(), atol=0.005)
    for index in (1, 4):
        inside = (y * data.views[index].width_px + x)[view == index]
        assert len(np.unique(inside)) == sizes[index]
    again = data.sample_pixels(np.random.default_rng(5), 200_000)
    np.testing.assert_array_equal(np.stack(again), np.stack([view, y, x]))


def test_mixed_depths_and_alpha(tmp_path, make_scene):
    shape = (24, 32)
    images = [
        ("a.png", 0, np.full((*shape, 3), 51, np.uint8)),
        ("b.png", 0, np.full((*shape, 4), [65535, 13107, 0, 32768], np.uint16)),
        ("c.exr", 0, np.full((*shape, 3), 0.2140411, np.float32)),
        ("d.png", 0, np.full(shape, 255, np.uint8)),
    ]
    data = Dataset.open(make_scene(tmp_path / "scene", images=images), tmp_path / "cache")
    assert data.has_alpha and not data.has_masks
    pixels = np.arange(4), np.full(4, 3), np.full(4, 5)
    rgb, alpha, weight = data.pixels(*pixels)
    np.testing.assert_allclose(rgb, [[0.2] * 3, [1, 0.2, 0], [0.5] * 3, [1] * 3], atol=2e-5)
    np.testing.assert_allclose(alpha, [1, 128 / 255, 1, 1])
    assert (weight == 1).all()


def test_opaque_alpha_channel_is_ignored(tmp_path, make_scene):
    images = [(f"{i}.png", 0, np.full((24, 32, 4), 255, np.uint8)) for i in range(3)]
    data = Dataset.open(make_scene(tmp_path / "scene", images=images), tmp_path / "cache")
    assert not data.has_alpha
    assert not (tmp_path / "cache/alpha.bin").exists()


def test_dataset_masks_as_alpha_and_as_ignore(tmp_path, make_scene, save_image, coded):
    transparent = np.concatenate([coded(32, 24, 0), np.full((24, 32, 1), 102, np.uint8)], axis=2)
    images = [
        ("ein Ordner/a.png", 0, transparent),
        ("b.png", 0, coded(32, 24, 1)),
        ("c.png", 0, coded(32, 24, 2)),
    ]
    root = make_scene(tmp_path / "scene", images=images)
    left = np.zeros((24, 32), np.uint8)
    left[:, :16] = 255
    left[:, 16] = 51
    save_image(root / "masks/ein Ordner/a.png.png", left)
    save_image(root / "masks/b.png.png", left)
    # By name, "b.png" and "c.png" come before "ein Ordner/a.png".
    view, x = np.repeat([2, 0, 1], 3), np.tile([15, 16, 17], 3)
    y = np.full(9, 4)

    ignoring = Dataset.open(root, tmp_path / "cache", masks="ignore")
    assert ignoring.has_masks and ignoring.has_alpha
    assert [v.name for v in ignoring.views] == ["b.png", "c.png", "ein Ordner/a.png"]
    _, alpha, weight = ignoring.pixels(view, y, x)
    np.testing.assert_allclose(alpha, np.float32([0.4] * 3 + [1] * 6))
    assert weight.tolist() == [1, 0, 0, 1, 0, 0, 1, 1, 1]

    cut_out = Dataset.open(root, tmp_path / "cache", masks="alpha")
    assert cut_out.has_alpha
    _, alpha, weight = cut_out.pixels(view, y, x)
    np.testing.assert_allclose(alpha, np.float32([0.4, 0.08, 0, 1, 0.2, 0, 1, 1, 1]), atol=1e-7)
    assert (weight == 1).all()


def test_masks_as_alpha_are_refused_where_there_are_none(tmp_path, make_scene):
    root = make_scene(tmp_path / "scene")
    with pytest.raises(DatasetError, match="Masks are to be the alpha"):
        Dataset.open(root, tmp_path / "cache", masks="alpha")


def test_dataset_black_masks_warn(tmp_path, make_scene, save_image):
    root = make_scene(tmp_path / "scene")
    for i in range(4):
        save_image(root / f"masks/view_{i}.png.png", np.full((24, 32), 0 if i == 2 else 255, np.uint8))
    for _ in range(2):  # told again when the cache is found, too
        data = Dataset.open(root, tmp_path / "cache")
        assert any("view_2.png" in warning for warning in data.warnings)


def test_masks_follow_max_side(tmp_path, make_scene, save_image):
    root = make_scene(tmp_path / "scene")
    mask = np.zeros((24, 32), np.uint8)
    mask[:12] = 255
    for i in range(4):
        save_image(root / f"masks/view_{i}.png.png", mask)
    data = Dataset.open(root, tmp_path / "cache", max_side=16)
    _, _, weight = data.view_image(0)
    assert weight.shape == (12, 16)
    assert (weight[:6] == 1).all() and (weight[6:] == 0).all()


def test_held_out_names_reach_the_dataset(tmp_path, make_scene):
    root = make_scene(tmp_path / "scene")
    data = Dataset.open(root, tmp_path / "cache", held_out=("view_2.png",))
    assert data.test_indices.tolist() == [2]
    assert data.train_indices.tolist() == [0, 1, 3]
    with pytest.raises(DatasetError, match=r"absent\.png"):
        Dataset.open(root, tmp_path / "other", held_out=("absent.png",))
    assert not (tmp_path / "other").exists()


def test_extent_uses_training_cameras(tmp_path, make_scene):
    data = Dataset.open(make_scene(tmp_path / "scene"), tmp_path / "cache", test_every=0)
    centres = np.stack([view.origin_world for view in data.views])
    expected = 1.1 * np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
    assert data.extent == pytest.approx(expected)


def test_names_of_the_index_are_plain_json(tmp_path, make_scene):
    Dataset.open(make_scene(tmp_path / "scene"), tmp_path / "cache")
    assert json.loads((tmp_path / "cache/pixels.json").read_text())["bits"] == 8
