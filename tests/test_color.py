import numpy as np

from octasplat.engine.core.color import linear_to_srgb, round_to_bytes, srgb_to_linear, to_bytes


def test_known_values_of_the_srgb_curve() -> None:
    srgb = np.array([-0.5, 0.0, 0.02, 0.5, 1.0])
    linear = srgb_to_linear(srgb)
    np.testing.assert_allclose(linear, [0, 0, 0.02 / 12.92, 0.21404114, 1.0], atol=1e-6)
    np.testing.assert_allclose(linear_to_srgb(linear)[1:], srgb[1:], atol=1e-7)


def test_precision_and_shape_are_kept() -> None:
    values = np.linspace(0, 1, 12, dtype=np.float32).reshape(2, 2, 3)
    assert srgb_to_linear(values).dtype == np.float32
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-6)


def test_bytes_are_rounded_and_clipped() -> None:
    np.testing.assert_array_equal(
        to_bytes(np.array([-1, 0, 0.499 / 255, 0.501 / 255, 1, 2.0])), [0, 0, 0, 1, 255, 255]
    )


def test_halves_are_rounded_to_the_even_step() -> None:
    halves = (np.arange(8) + 0.5).astype(np.float32)
    np.testing.assert_array_equal(round_to_bytes(halves), [0, 2, 2, 4, 4, 6, 6, 8])
    np.testing.assert_array_equal(to_bytes(halves / np.float64(255)), round_to_bytes(halves))
    np.testing.assert_array_equal(round_to_bytes(np.array([-3.0, 255.4, 300.0])), [0, 255, 255])
