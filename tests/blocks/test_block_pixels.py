"""Pixels of a block: the tiles with a ray to whose color its Gaussians contribute, against brute force."""

import numpy as np

from octasplat.engine.blocks.pixel_selection import (
    MIN_CONTRIBUTION,
    MIN_FREQUENCY,
    seen_pixels,
    select_pixels,
)
from octasplat.engine.dataset.view_tiles import FULL_FREQUENCY, Rectangles, ViewTiles
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.engine.train.sampling.pixel_sampler import PixelSampler
from tests.support.planar_dataset import PlanarDataset


def pixels_in(rectangles: Rectangles, view: int, side_px: int) -> np.ndarray:
    """A mask of the pixels of one view that lie in rectangles; none lies in two."""
    counts = np.zeros((side_px, side_px), int)
    for owner, (x, y), (width, height) in zip(
        rectangles.view, rectangles.corner_px, rectangles.size_px, strict=True
    ):
        if owner == view:
            counts[y : y + height, x : x + width] += 1
    assert counts.max() <= 1
    return counts == 1


def frequencies_in(rectangles: Rectangles, view: int, side_px: int) -> np.ndarray:
    """How often each pixel of one view is drawn."""
    found = np.zeros((side_px, side_px), np.int64)
    rows = zip(rectangles.view, rectangles.corner_px, rectangles.size_px, rectangles.frequency, strict=True)
    for owner, (x, y), (width, height), frequency in rows:
        if owner == view:
            found[y : y + height, x : x + width] += frequency
    return found


def test_tiles_cover_a_view_and_rays_lie_within_them() -> None:
    tiles = ViewTiles.of_view(3, 1000, 700)
    assert tiles.rows_px[0] == 0 and tiles.rows_px[-1] == 700
    assert tiles.columns_px[0] == 0 and tiles.columns_px[-1] == 1000
    assert np.diff(tiles.rows_px).min() >= 64 and np.diff(tiles.columns_px).max() < 128
    whole = tiles.rectangles(np.full(tiles.shape, FULL_FREQUENCY))
    assert whole.pixel_count == whole.drawn_pixel_count == 700_000 and len(whole) == tiles.shape[0]
    frequency = np.zeros(tiles.shape, np.int64)
    frequency[2, :6] = [0, 2, 2, 4, 0, 8]
    some = tiles.rectangles(frequency)
    assert some.frequency.tolist() == [2, 4, 8]
    np.testing.assert_array_equal(some.corner_px[:, 0], tiles.columns_px[[1, 3, 5]])
    np.testing.assert_array_equal(
        some.size_px.sum(axis=1) - some.size_px[0, 1], np.diff(tiles.columns_px[[1, 3, 4, 5, 6]])[[0, 1, 3]]
    )
    view, y, x = tiles.pixels()
    assert set(view) == {3} and y.max() < 700 and x.max() < 1000
    values = np.stack([y, x], axis=1).astype(np.float32)
    maxima = tiles.tile_maxima(values)
    assert (maxima[:, 0, 0] < tiles.rows_px[1:]).all() and (maxima[:, 0, 0] >= tiles.rows_px[:-1]).all()
    assert (maxima[0, :, 1] < tiles.columns_px[1:]).all()


def test_selected_tiles_are_those_of_brute_force() -> None:
    """Each tile is asked on its own what the slow twin sees of the members in its rays."""
    world = PlanarDataset(count=4, side_px=80)
    gaussians = world.initial_gaussians(60)
    gaussians.opacity_logits[:] = np.random.default_rng(1).uniform(-4, 2, 60)
    gaussians.log_scales -= np.float32(1)
    is_left = gaussians.means_world[:, 0] < -0.2
    is_above = gaussians.means_world[:, 1] < -0.4
    tracer = make_tracer(TraceSettings(), threads=1)
    chosen = select_pixels(world, gaussians, [is_left, is_above], tracer, lambda: None)
    slow = make_tracer(TraceSettings(tracer="reference"))
    for member, rectangles in zip((is_left, is_above), chosen, strict=True):
        slow.build(gaussians, member.astype(np.float32)[:, None])
        for view in world.train_indices.tolist():
            tiles = ViewTiles.of_view(view, 80, 80)
            _, y, x = tiles.pixels()
            traced = slow.trace(world.rays(np.full(len(y), view), y, x))
            shares, alpha = traced.features[:, 0], traced.alpha
            expected = np.zeros((80, 80), np.int64)
            for top, bottom in zip(tiles.rows_px, tiles.rows_px[1:], strict=False):
                for left, right in zip(tiles.columns_px, tiles.columns_px[1:], strict=False):
                    inside = (y >= top) & (y < bottom) & (x >= left) & (x < right)
                    if shares[inside].max() >= MIN_CONTRIBUTION:
                        parts = round(FULL_FREQUENCY * float(shares[inside].sum() / alpha[inside].sum()))
                        expected[top:bottom, left:right] = max(parts, MIN_FREQUENCY)
            assert len(np.unique(expected)) > 2 and expected.min() == 0
            np.testing.assert_array_equal(frequencies_in(rectangles, view, 80), expected)
    assert set(np.unique(chosen[0].view)) <= set(world.train_indices.tolist())


def test_seen_pixels_add_up_to_all_pixels_before_an_opaque_scene() -> None:
    world = PlanarDataset(count=4, side_px=40)
    gaussians = world.initial_gaussians(400)
    gaussians.opacity_logits[:] = 6
    gaussians.log_scales[:] += 1
    seen = seen_pixels(world, gaussians, make_tracer(TraceSettings(), threads=1), lambda: None)
    np.testing.assert_allclose(seen.sum(), 3 * 40 * 40, rtol=0.01)


def test_pixels_are_drawn_as_often_over_all_blocks_as_in_one_training() -> None:
    """Members that cover everything, opaque: the frequencies of a tile add up to all parts."""
    world = PlanarDataset(count=4, side_px=80)
    gaussians = world.initial_gaussians(400)
    gaussians.opacity_logits[:] = 6
    gaussians.log_scales[:] += 1
    is_left = gaussians.means_world[:, 0] < 0
    tracer = make_tracer(TraceSettings(), threads=1)
    chosen = select_pixels(world, gaussians, [is_left, ~is_left], tracer, lambda: None)
    for view in world.train_indices.tolist():
        total = sum(frequencies_in(rectangles, view, 80) for rectangles in chosen)
        assert (np.abs(total - FULL_FREQUENCY) <= 1).all()
    drawn = sum(rectangles.drawn_pixel_count for rectangles in chosen)
    assert abs(drawn - 3 * 80 * 80) < 0.05 * 3 * 80 * 80


def test_pixels_are_drawn_in_proportion_to_the_frequency_of_their_rectangle() -> None:
    parts = np.array([1, 4, FULL_FREQUENCY])
    rectangles = Rectangles(
        np.array([0, 1, 1]), np.array([[0, 0], [0, 0], [40, 0]]), np.full((3, 2), 32), parts
    )
    assert rectangles.drawn_pixel_count == 32 * 32 * parts.sum() // FULL_FREQUENCY
    sampler, rng = PixelSampler.of_rectangles(rectangles), np.random.default_rng(0)
    assert sampler.pixel_count == rectangles.drawn_pixel_count
    drawn = [
        sampler.pixels(rng, 60_000),
        sampler.ray_patches(rng, 2_000, rays=16, side=8),
        sampler.patches(rng, 2_000, 4),
    ]
    for view, _, x in drawn:
        counts = np.array(
            [(view == 0).sum(), ((view == 1) & (x < 32)).sum(), ((view == 1) & (x >= 40)).sum()]
        )
        np.testing.assert_allclose(counts / counts.sum(), parts / parts.sum(), atol=0.03)


def test_sampler_draws_only_pixels_of_its_rectangles_and_all_of_them() -> None:
    rectangles = Rectangles(
        np.array([1, 1, 4]), np.array([[3, 5], [20, 30], [0, 0]]), np.array([[7, 4], [5, 9], [6, 6]])
    )
    sampler, rng = PixelSampler.of_rectangles(rectangles), np.random.default_rng(0)
    allowed = {view: pixels_in(rectangles, view, 40) for view in (1, 4)}
    drawn = [
        sampler.pixels(rng, 4000),
        sampler.ray_patches(rng, 60, rays=16, side=8),
        sampler.patches(rng, 100, 4),
    ]
    for view, y, x in drawn:
        for number, mask in allowed.items():
            assert mask[y[view == number], x[view == number]].all()
        assert set(np.unique(view)) == {1, 4}
    view, y, x = drawn[0]
    assert len(set(zip(view.tolist(), y.tolist(), x.tolist(), strict=True))) == rectangles.pixel_count
    assert sampler.pixel_count == rectangles.pixel_count == 7 * 4 + 5 * 9 + 36
    only = rectangles.of_views(np.array([4]))
    assert len(only) == 1 and only.pixel_count == 36
