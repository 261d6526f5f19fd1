"""What clean-up removes, on scenes in which it is known."""

from collections.abc import Callable

import numpy as np
import pytest

from octasplat.engine.edit.cleaning import clean, linked_groups
from octasplat.engine.edit.edit_options import CleanupOptions
from octasplat.engine.gaussians.model import FlatGaussians, concatenate

Make = Callable[..., FlatGaussians]


@pytest.fixture
def sheet(make_scene: Make) -> FlatGaussians:
    """Two thousand Gaussians on a square of side 2, about as far apart as they are large."""
    g = make_scene(2000, sh_degree=0, size=0.03)
    g.means_world[:, 2] = 0.0
    return g


def test_clean_counts_each_removed_gaussian_once(sheet: FlatGaussians) -> None:
    sheet.opacity_logits[:] = 2.0
    sheet.log_scales[:] = np.log(0.03)
    sheet.opacity_logits[:10] = -6.0
    sheet.log_scales[5:20] = np.log(0.5)
    sheet.log_scales[20:24] = [np.log(1e-4), np.log(1e-5)]
    sheet.log_scales[24] = [np.log(0.03), np.log(1e-5)]  # a needle is not small
    options = CleanupOptions(min_opacity=0.01, max_scale=0.4, min_scale=1e-3, floaters=False)
    keep, report = clean(sheet, options)
    np.testing.assert_array_equal(np.flatnonzero(~keep), np.arange(24))
    assert (report.faint, report.large, report.small, report.floating) == (10, 10, 4, 0)
    assert report.kept == 1976


def test_clean_removes_floaters_and_keeps_surface(sheet: FlatGaussians, make_scene: Make) -> None:
    alone = make_scene(30, sh_degree=0, seed=1, size=0.02)
    alone.means_world = np.float32([0, 0, 3]) + 40 * alone.means_world
    clump = make_scene(12, sh_degree=0, seed=2, size=0.05)
    clump.means_world = np.float32([0.3, 0, 1]) + 0.05 * clump.means_world
    sheet.opacity_logits[:] = alone.opacity_logits[:] = clump.opacity_logits[:] = 1.0
    keep, report = clean(concatenate([sheet, alone, clump]), CleanupOptions())
    assert not keep[2000:].any()
    assert (~keep[:2000]).sum() <= 4
    assert report.floating == (~keep).sum()
    assert clean(concatenate([sheet, clump]), CleanupOptions(min_group=10))[0][2000:].all()
    assert clean(concatenate([sheet, alone]), CleanupOptions(floaters=False))[0].all()


def test_clean_keeps_coarse_background(sheet: FlatGaussians, make_scene: Make) -> None:
    wall = make_scene(300, sh_degree=0, seed=3, size=3.0)
    wall.means_world = wall.means_world * np.float32([30, 30, 0]) + np.float32([0, 0, 50])
    sheet.opacity_logits[:] = wall.opacity_logits[:] = 1.0
    keep, _ = clean(concatenate([sheet, wall]), CleanupOptions())
    assert keep[2000:].mean() > 0.97


def test_clean_oversized_gaussian_does_not_protect_floaters(sheet: FlatGaussians, make_scene: Make) -> None:
    sheet.opacity_logits[:] = 1.0
    sheet.log_scales[0] = np.log(20.0)
    alone = make_scene(5, sh_degree=0, seed=1, size=0.02)
    alone.opacity_logits[:] = 1.0
    alone.means_world = np.float32([0, 0, 3]) + alone.means_world
    keep, _ = clean(concatenate([sheet, alone]), CleanupOptions())
    assert not keep[2000:].any()


def test_clean_keeps_small_scene(make_scene: Make) -> None:
    for count in (1, 2, 5):
        g = make_scene(count, spread=0.01)
        g.opacity_logits[:] = 1.0
        assert clean(g, CleanupOptions())[0].all()


def test_linked_groups_have_known_labels_and_sizes(make_scene: Make) -> None:
    g = make_scene(60, size=0.05, spread=0.05)
    g.means_world[40:] += 10.0
    labels, sizes = linked_groups(g, 3.0, 12)
    assert sorted(sizes) == [20, 40]
    assert len(set(labels[:40])) == len(set(labels[40:])) == 1
