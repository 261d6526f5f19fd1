"""Batches: uniform over the pixels of the training views, with whole patches."""

from dataclasses import replace

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.train.sampling.pixel_sampler import PixelSampler
from tests.support.planar_dataset import PlanarDataset, batch_source, small_config

SIZES = np.array([[8, 6], [20, 10], [16, 16], [5, 3]], np.int64)


def test_pixels_are_uniform_over_the_given_views() -> None:
    sampler = PixelSampler(np.array([0, 1, 3]), SIZES)
    assert sampler.pixel_count == 48 + 200 + 15
    count = 263 * 400
    view, y, x = sampler.pixels(np.random.default_rng(0), count)
    tally = np.zeros((4, 10, 20))
    np.add.at(tally, (view, y, x), 1)
    for index in (0, 1, 3):
        width, height = SIZES[index]
        inside = tally[index, :height, :width]
        # 400 a pixel, give or take 20: 6 sigma.
        assert np.abs(inside - 400).max() < 120
        assert inside.sum() == tally[index].sum()
    assert tally[2].sum() == 0


def test_windows_are_grids_with_one_pixel_a_cell() -> None:
    sampler = PixelSampler(np.array([1]), np.array([[8, 6], [300, 200]]))
    view, y, x = (
        a.reshape(400, 16) for a in sampler.ray_patches(np.random.default_rng(0), 400, rays=16, side=20)
    )
    assert (view == 1).all()
    # those that are nowhere near the view's edges, where they would be folded
    inside = (x.min(1) > 20) & (x.max(1) < 279) & (y.min(1) > 20) & (y.max(1) < 179)
    assert inside.mean() > 0.5
    # quarter by quarter, and within a quarter likewise
    across = 5 * np.array([0, 1, 0, 1, 2, 3, 2, 3, 0, 1, 0, 1, 2, 3, 2, 3])
    down = 5 * np.array([0, 0, 1, 1, 0, 0, 1, 1, 2, 2, 3, 3, 2, 2, 3, 3])
    for columns, rows in zip(x[inside], y[inside], strict=True):
        # some corner puts each pixel into its own 5 x 5 cell
        assert (columns - across).max() - (columns - across).min() < 5
        assert (rows - down).max() - (rows - down).min() < 5


def test_windows_reach_every_pixel_about_as_often() -> None:
    sampler = PixelSampler(np.array([0, 1, 3]), SIZES)
    view, y, x = sampler.ray_patches(np.random.default_rng(0), 263 * 400 // 16, rays=16, side=8)
    tally = np.zeros((4, 10, 20))
    np.add.at(tally, (view, y, x), 1)
    for index in (0, 1, 3):
        width, height = SIZES[index]
        inside = tally[index, :height, :width]
        assert inside.sum() == tally[index].sum()
        assert inside.min() > 200
        assert inside.max() < 800


def test_windows_of_a_batch_are_spread_over_the_views_and_within_them() -> None:
    sizes = np.array([[60, 40]] * 10)
    sampler = PixelSampler(np.arange(10), sizes)
    for turn in range(5):
        windows = sampler.ray_patches(np.random.default_rng(turn), 60, rays=16, side=20, index=turn)
        view, y, x = (a.reshape(60, 16) for a in windows)
        assert (np.bincount(view[:, 0]) == 6).all()
        for index in range(10):  # 3 x 2 tiles: a window in each, but for the seam between two views
            tiles = {
                (round(b), round(a))
                for a, b in zip(
                    x[view[:, 0] == index].mean(1) // 20, y[view[:, 0] == index].mean(1) // 20, strict=True
                )
            }
            assert len(tiles) >= 4


def test_ray_patches_cover_views_evenly() -> None:
    """Drawn at random, of 300 windows on 50 views some would have fewer than three."""
    sampler = PixelSampler(np.arange(50), np.array([[60, 40]] * 50))
    rng = np.random.default_rng(0)
    views = [sampler.ray_patches(rng, 3, rays=16, side=20, index=turn)[0][::16] for turn in range(100)]
    tally = np.bincount(np.concatenate(views), minlength=50)
    assert tally.min() >= 5 and tally.max() <= 7


def test_ray_patches_are_contiguous() -> None:
    sampler = PixelSampler(np.array([1, 2]), SIZES)
    view, y, x = (a.reshape(500, 4, 4) for a in sampler.patches(np.random.default_rng(0), 500, 4))
    assert (view == view[:, :1, :1]).all()
    assert (np.diff(y, axis=1) == 1).all() and (np.diff(y, axis=2) == 0).all()
    assert (np.diff(x, axis=2) == 1).all() and (np.diff(x, axis=1) == 0).all()
    width, height = SIZES[view[:, 0, 0]].T
    assert (x[:, 0, 0] >= 0).all() and (x[:, 0, -1] < width).all() and (y[:, -1, 0] < height).all()
    corners = set(zip(view[:, 0, 0].tolist(), y[:, 0, 0].tolist(), x[:, 0, 0].tolist(), strict=True))
    assert {(1, 0, 0), (1, 6, 16), (2, 0, 0)} & corners
    # Views are drawn by their area.
    assert (view[:, 0, 0] == 2).mean() == pytest.approx(256 / 456, abs=0.1)


def test_patch_as_large_as_the_view() -> None:
    _, y, x = PixelSampler(np.array([2]), SIZES).patches(np.random.default_rng(0), 1, 16)
    assert y.tolist() == np.repeat(np.arange(16), 16).tolist()
    assert x.tolist() == np.tile(np.arange(16), 16).tolist()


@pytest.mark.parametrize(("ssim", "fraction"), [(0.0, 0.25), (0.2, 0.6), (0.2, 1.0)])
@pytest.mark.parametrize("rays", [256, 1000, 1024])
@pytest.mark.parametrize("ray_patch_rays", [1, 64])
def test_batch_has_its_rays(ssim: float, fraction: float, rays: int, ray_patch_rays: int) -> None:
    world = PlanarDataset(side_px=40)
    config = small_config(
        rays_per_batch=rays,
        ray_patch_rays=ray_patch_rays,
        ray_patch_side=24,
        ssim_patch_fraction=fraction,
        loss={"ssim": ssim},
    )
    batch = batch_source(world, config).draw(np.random.default_rng(0))
    assert len(batch.rgb_srgb) == len(batch.rays) == len(batch.alpha) == len(batch.weight) == rays
    assert abs(batch.ssim_patch_count * 256 - (fraction * rays if ssim else 0)) <= 256
    np.testing.assert_allclose(np.linalg.norm(batch.rays.directions_world, axis=1), 1, atol=1e-6)


def test_ssim_is_refused_where_it_would_be_ignored() -> None:
    with pytest.raises(ConfigError, match="only 12 pixels wide or high; lower ssim_patch_side"):
        batch_source(PlanarDataset(side_px=12), small_config(loss={"ssim": 0.2}))
    with pytest.raises(ConfigError, match="raise rays_per_batch or ssim_patch_fraction"):
        batch_source(
            PlanarDataset(), small_config(rays_per_batch=256, ssim_patch_fraction=0.3, loss={"ssim": 0.2})
        )


@pytest.mark.parametrize(("background", "has_alpha"), [("white", False), ("auto", False), ("auto", True)])
def test_photographs_lie_over_the_background(background: str, has_alpha: bool) -> None:
    world = PlanarDataset()
    world.has_alpha = has_alpha
    batch = batch_source(world, small_config(background=background)).draw(np.random.default_rng(0))
    if has_alpha:
        assert len(np.unique(batch.background_srgb)) == 3
    else:
        assert batch.background_srgb.tolist() == [float(background == "white")] * 3
    np.testing.assert_array_equal(batch.target_srgb, batch.rgb_srgb)  # opaque throughout
    clear = replace(batch, alpha=np.zeros_like(batch.alpha))
    assert (clear.target_srgb == batch.background_srgb).all()
