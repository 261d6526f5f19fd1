import numpy as np
import pytest
from scipy.ndimage import fourier_shift, gaussian_filter

from benchmarks.picture_fits import (
    fit_affine_color,
    fit_homography,
    fit_local_gain,
    fit_local_motion,
    fit_shift,
)
from benchmarks.picture_measures import BAND_NAMES, band_powers, error_shares, sharpness_db
from octasplat.engine.core.psnr import psnr

HEIGHT, WIDTH = 72, 96


@pytest.fixture
def photograph():
    """Smooth random colors in [0.2, 0.8]."""
    noise = np.random.default_rng(3).normal(size=(HEIGHT, WIDTH, 3))
    smooth = gaussian_filter(noise, (2, 2, 0), mode="wrap")
    low, high = smooth.min(), smooth.max()
    return (0.2 + 0.6 * (smooth - low) / (high - low)).astype(np.float32)


@pytest.fixture
def weight():
    return np.ones((HEIGHT, WIDTH), np.float32)


def shifted(picture, down, across):
    channels = [
        np.fft.ifft2(fourier_shift(np.fft.fft2(picture[..., c]), (down, across))).real for c in range(3)
    ]
    return np.stack(channels, axis=-1).astype(np.float32)


def test_shift_of_a_fraction_of_a_pixel_is_found(photograph, weight):
    found = fit_shift(shifted(photograph, 0.25, 0.4), photograph, weight)
    # what the photograph shows at x lies at x + 0.4 in the render
    np.testing.assert_allclose(found.shift_px, (0.4, 0.25), atol=0.02)
    assert found.corner_px == pytest.approx(np.hypot(0.4, 0.25), abs=0.03)
    inner = weight.copy()
    inner[:4] = inner[-4:] = inner[:, :4] = inner[:, -4:] = 0
    assert psnr(found.picture, photograph, inner) > 45 > psnr(shifted(photograph, 0.25, 0.4), photograph)


def test_shift_of_equal_pictures_is_none(photograph, weight):
    found = fit_shift(photograph, photograph, weight)
    assert found.corner_px < 1e-6
    np.testing.assert_array_equal(found.picture, photograph)


def test_homography_finds_a_zoom(photograph, weight):
    y, x = np.indices((HEIGHT, WIDTH), np.float64)
    from scipy.ndimage import map_coordinates

    places = np.stack([(y - 35.5) / 1.02 + 35.5, (x - 47.5) / 1.02 + 47.5])
    render = np.stack(
        [
            map_coordinates(photograph[..., c].astype(float), places, order=3, mode="nearest")
            for c in range(3)
        ],
        axis=-1,
    ).astype(np.float32)
    shift, homography = (fit(render, photograph, weight) for fit in (fit_shift, fit_homography))
    np.testing.assert_allclose(homography.matrix[:2, :2], 1.02 * np.eye(2), atol=2e-3)
    assert np.hypot(*homography.shift_px) < 0.1
    assert psnr(homography.picture, photograph) > psnr(shift.picture, photograph) + 10


def test_local_motion_undoes_what_one_shift_cannot(photograph, weight):
    render = photograph.copy()
    render[:, : WIDTH // 2] = shifted(photograph, 0.5, 0.0)[:, : WIDTH // 2]
    render[:, WIDTH // 2 :] = shifted(photograph, -0.5, 0.0)[:, WIDTH // 2 :]
    moved, mean_px = fit_local_motion(render, photograph, weight)
    one = fit_shift(render, photograph, weight)
    assert psnr(moved, photograph) > psnr(one.picture, photograph) + 5
    assert 0.3 < mean_px < 0.55


def test_masked_pixels_do_not_pull(photograph, weight):
    render = shifted(photograph, 0.0, 0.4)
    render[:, 60:] = 0.9
    weight[:, 56:] = 0
    np.testing.assert_allclose(fit_shift(render, photograph, weight).shift_px, (0.4, 0.0), atol=0.03)
    changed = render.copy()
    changed[:, 60:] = 0.1
    one, other = (fit_affine_color(r, photograph, weight)[:, :56] for r in (render, changed))
    np.testing.assert_array_equal(one, other)


def test_affine_color_undoes_a_mixing_of_channels(photograph, weight):
    mixing = np.array([[0.8, 0.1, 0.0], [0.05, 0.9, 0.0], [0.0, 0.1, 0.7]])
    render = (photograph @ mixing + 0.03).astype(np.float32)
    np.testing.assert_allclose(fit_affine_color(render, photograph, weight), photograph, atol=1e-4)


def test_local_gain_finds_one_gain_and_a_ramp(photograph, weight):
    np.testing.assert_allclose(
        fit_local_gain((photograph / 1.1).astype(np.float32), photograph, weight), photograph, atol=1e-4
    )
    ramp = np.linspace(1.0, 1.2, WIDTH)[None, :, None]
    np.testing.assert_allclose(
        fit_local_gain((photograph / ramp).astype(np.float32), photograph, weight), photograph, atol=2e-3
    )


def test_wave_lies_in_its_band():
    x = np.arange(128)
    # 6 px, the band 4 to 8 px
    wave = 0.5 + 0.25 * np.sin(2 * np.pi * x / 6)
    picture = np.broadcast_to(wave[None, :, None], (128, 128, 3)).astype(np.float32)
    powers = band_powers(picture)
    assert BAND_NAMES[int(powers.argmax())] == "4 to 8 px"
    # a sine of amplitude 0.25 has a variance of 0.25^2 / 2
    assert powers.sum() == pytest.approx(0.25**2 / 2, rel=0.05)
    assert powers[3] > 0.98 * powers.sum()


def test_blur_takes_fine_bands_away(photograph):
    rng = np.random.default_rng(0)
    sharp = np.clip(photograph + rng.normal(0, 0.05, photograph.shape), 0, 1).astype(np.float32)
    blurred = gaussian_filter(sharp, (1.5, 1.5, 0)).astype(np.float32)
    found = sharpness_db(blurred, sharp)
    assert found[-1] < -15
    assert abs(found[0]) < 1
    assert (np.diff(found) < 0).all()
    assert sharpness_db(sharp, sharp) == pytest.approx(np.zeros(len(BAND_NAMES)))
    shares = error_shares(blurred, sharp)
    assert shares.sum() == pytest.approx(1)
    assert shares[-1] > 0.5
