"""Numbers for what is drawn at random in a picture: even over its pixels and over the samples of each."""

import numpy as np

from octasplat.engine.render.renderer import pixel_jitter


def test_samples_of_a_pixel_leave_no_large_gap_in_either_number() -> None:
    pixels = np.arange(500)
    for samples, largest in ((4, 0.5), (16, 0.25)):
        found = np.sort(np.stack([pixel_jitter(pixels, sample) for sample in range(samples)]), axis=0)
        gaps = np.diff(np.concatenate([found, found[:1] + 1]), axis=0)
        assert gaps.max() < largest


def test_pixels_differ_and_are_even() -> None:
    found = pixel_jitter(np.arange(20_000), 3)
    assert found.min() >= 0 and found.max() < 1
    counts, _, _ = np.histogram2d(*found, bins=10, range=[[0, 1], [0, 1]])
    assert counts.min() > 130 and counts.max() < 270  # 200 each
    np.testing.assert_array_equal(found, pixel_jitter(np.arange(20_000), 3))
