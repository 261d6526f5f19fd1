import json

import numpy as np
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.psnr import fit_color, psnr
from octasplat.engine.evaluate import metrics
from octasplat.engine.evaluate.summary import format_mean_metrics
from octasplat.engine.evaluate.view_metrics import (
    RenderedView,
    bootstrap_interval,
    measure_view,
    summarize_views,
)
from tests.support.daily import some_daily


def view(name="a.jpg", error=0.1, size=(30, 40), seed=0, **changes):
    rng = np.random.default_rng(seed)
    reference = (rng.integers(60, 190, (*size, 3)) / np.float32(255)).astype(np.float32)
    render = reference + np.float32(error)
    weight = np.ones(size, np.float32)
    return RenderedView(name, render, reference, weight)._replace(**changes)


def test_metrics_are_those_of_the_images_rounded_to_8_bits():
    one = view(error=0.1003)
    row, flip_map = measure_view(one)
    render, reference = (metrics.quantize_8_bit(image) for image in (one.render, one.reference))
    assert row.psnr == psnr(render, reference)
    corrected = fit_color(render, reference, one.weight)
    assert row.psnr_colour_corrected == psnr(corrected, reference)
    assert row.ssim == metrics.ssim(render, reference)
    assert row.ssim_valid == metrics.ssim_valid(render, reference)
    assert row.ms_ssim is None
    assert row.flip == pytest.approx(flip_map.mean())
    assert (row.width, row.height) == (40, 30)
    assert row.psnr_foreground is None


def test_metrics_ignore_errors_below_quantisation():
    assert measure_view(view(error=0.3 / 255)).metrics.psnr == np.inf


def test_metrics_ignore_masked_pixels():
    weight = np.ones((30, 40), np.float32)
    weight[:, :15] = 0
    clean = view(weight=weight)
    spoiled = clean.render.copy()
    spoiled[:, :15] = 0.9
    assert measure_view(clean._replace(render=spoiled)).metrics == measure_view(clean).metrics


def test_foreground_psnr_is_over_covered_valid_pixels():
    one = view(error=0.0)
    render = one.render.copy()
    render[:10] += 51 / 255
    alpha = np.zeros((30, 40), np.float32)
    alpha[:20] = 1
    weight = one.weight.copy()
    row = measure_view(one._replace(render=render, alpha=alpha, weight=weight)).metrics
    assert row.psnr_foreground == pytest.approx(-10 * np.log10(0.04 / 2), abs=1e-4)
    weight[:10] = 0
    assert (
        measure_view(one._replace(render=render, alpha=alpha, weight=weight)).metrics.psnr_foreground
        == np.inf
    )
    row = measure_view(one._replace(alpha=np.zeros((30, 40), np.float32))).metrics
    assert row.psnr_foreground is None


def test_summary_is_mean_of_views():
    rows = [measure_view(view(f"{k}.jpg", error, seed=k)).metrics for k, error in enumerate((0.1, 0.05))]
    summary = summarize_views(rows)
    for key in ("psnr", "ssim", "ssim_valid", "flip"):
        assert summary.mean[key] == pytest.approx(np.mean([getattr(row, key) for row in rows]))
    assert summary.mean["ms_ssim"] is None
    assert "psnr_foreground" not in summary.mean


def test_evaluation_json_layout():
    alpha = np.ones((30, 40), np.float32)
    rows = [
        measure_view(view("a.jpg", 0.1, alpha=alpha)).metrics,
        measure_view(view("sub/b.jpg", 0.0, size=(170, 180))).metrics,
    ]
    run = {
        "gaussians": 7,
        "iterations": 9,
        "seconds": 1.5,
        "resolution": {"scale": 2},
        "seed": 0,
        "versions": {},
    }
    content = summarize_views(rows).as_dict(run)
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    keys = {"psnr", "psnr_colour_corrected", "ssim", "ssim_valid", "ms_ssim", "flip", "psnr_foreground"}
    assert set(content) == {"mean", "mean_left_out", "mean_psnr_ci95", "views", "definitions", *run}
    assert content["mean_left_out"] == {
        "psnr": 1, "psnr_colour_corrected": 1, "ms_ssim": 1, "psnr_foreground": 1
    }  # fmt: skip
    assert content["mean"]["psnr"] == content["views"]["a.jpg"]["psnr"]
    assert set(content["mean"]) == keys
    assert list(content["views"]) == ["a.jpg", "sub/b.jpg"]
    assert set(content["views"]["a.jpg"]) == keys | {"width", "height"}
    assert keys <= set(content["definitions"])
    assert content["views"]["sub/b.jpg"]["psnr"] is None
    assert content["mean"]["ms_ssim"] == pytest.approx(1.0)


def test_view_without_valid_pixels_is_excluded_from_mean():
    empty = view("b.jpg", weight=np.zeros((30, 40), np.float32))
    rows = [measure_view(one).metrics for one in (view(), empty)]
    summary = summarize_views(rows)
    for key in ("psnr", "ssim", "ssim_valid", "flip"):
        assert summary.mean[key] == getattr(rows[0], key)
        assert summary.left_out[key] == 1
    assert (rows[1].ssim, rows[1].ssim_valid, rows[1].ms_ssim, rows[1].flip) == (None, None, None, None)


def test_mean_psnr_excludes_and_counts_perfect_views():
    rows = [measure_view(one).metrics for one in (view("a.jpg"), view("b.jpg", 0.0), view("c.jpg", 0.05))]
    summary = summarize_views(rows)
    assert summary.mean["psnr"] == pytest.approx((rows[0].psnr + rows[2].psnr) / 2)
    assert summary.left_out == {"psnr": 1, "psnr_colour_corrected": 1, "ms_ssim": 3}
    content = summary.as_dict({})
    assert content["views"]["b.jpg"]["psnr"] is None and content["mean"]["psnr"] is not None
    assert format_mean_metrics(content).startswith(
        "Mean over 3 held-out views (1 perfect or wholly masked left out)"
    )


@pytest.mark.parametrize("masked", some_daily([0.25, 0.5, 0.9], [0.5]))
def test_mask_does_not_change_uniform_error(masked):
    rng = np.random.default_rng(4)
    size = (400, 400)
    reference = np.full((*size, 3), 0.5, np.float32) + rng.normal(0, 0.05, (*size, 3)).astype(np.float32)
    render = reference + rng.normal(0, 0.05, (*size, 3)).astype(np.float32)
    whole = RenderedView("a.jpg", render, reference, np.ones(size, np.float32))
    weight = np.ones(size, np.float32)
    weight[: int(masked * size[0])] = 0
    one, other = (measure_view(each).metrics for each in (whole, whole._replace(weight=weight)))
    assert other.psnr == pytest.approx(one.psnr, abs=0.1)
    # Windows at the rim of the mask see the reference on one side: 3 of the 40 rows left, a little each.
    assert other.ssim == pytest.approx(one.ssim, abs=0.02)
    assert other.ssim_valid == pytest.approx(one.ssim_valid, abs=0.02)
    assert other.ms_ssim is None or other.ms_ssim == pytest.approx(one.ms_ssim, abs=0.05)
    assert other.flip == pytest.approx(one.flip, rel=0.1)


def test_confidence_interval_properties():
    rng = np.random.default_rng(0)
    few, many = rng.normal(25, 2, 10).tolist(), rng.normal(25, 2, 200).tolist()
    low, high = bootstrap_interval(few)
    assert low < np.mean(few) < high
    assert bootstrap_interval(few) == (low, high)
    # The interval of a mean of many values is that of the normal distribution.
    low, high = bootstrap_interval(many)
    assert high - low == pytest.approx(2 * 1.96 * np.std(many) / np.sqrt(200), rel=0.1)
    assert bootstrap_interval([25.0]) is None


def test_size_mismatch_is_refused_by_name():
    with pytest.raises(DatasetError, match=r"a\.jpg has 40 x 20 .* 40 x 30"):
        measure_view(view(render=np.zeros((20, 40, 3), np.float32)))


def test_metrics_non_finite_render_is_refused():
    with pytest.raises(DatasetError, match="no number"):
        measure_view(view(error=np.nan))


def test_two_views_of_one_name_are_refused():
    row = measure_view(view()).metrics
    with pytest.raises(DatasetError, match=r"a\.jpg"):
        summarize_views([row, row])
