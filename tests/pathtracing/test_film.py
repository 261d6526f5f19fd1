"""The image of a film, made some rows at a time."""

import numpy as np
import pytest

from octasplat.engine.pathtracing import film as film_module
from octasplat.engine.pathtracing.film import Film, StageImage, ToneCurve

WIDTH, HEIGHT = 17, 23


def random_film() -> Film:
    film, random = Film(HEIGHT, WIDTH, has_layers=True), np.random.default_rng(0)
    assert film.plate is not None
    for sums in (film.sums, film.sums_without_meshes, film.plate.sums):
        for values in sums:
            values[...] = 4 * random.random(values.shape)
        sums.samples[...] = 8
        sums.front[...] *= 0.5
    return film


@pytest.mark.parametrize(("tone", "transparent"), [("none", False), ("reinhard", False), ("filmic", True)])
def test_image_made_of_few_rows_at_a_time_is_the_same(
    tone: ToneCurve, transparent: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is worked out on the way takes several times the memory of a large image."""
    sizes: list[int] = []

    def counted(linear: np.ndarray, curve: ToneCurve) -> np.ndarray:
        sizes.append(len(linear))
        return apply_tone_curve(linear, curve)

    apply_tone_curve = film_module.apply_tone_curve
    monkeypatch.setattr(film_module, "apply_tone_curve", counted)

    def image(pixels_at_once: int) -> StageImage:
        monkeypatch.setattr(film_module, "PIXELS_AT_ONCE", pixels_at_once)
        sizes.clear()
        return random_film().image(exposure=0.5, tone=tone, transparent=transparent)

    whole = image(WIDTH * HEIGHT)
    assert sizes == [WIDTH * HEIGHT]
    parts = image(3 * WIDTH + 1)
    assert max(sizes) == 3 * WIDTH and sum(sizes) == WIDTH * HEIGHT
    np.testing.assert_allclose(parts.rgb_srgb, whole.rgb_srgb, rtol=1e-6)
    np.testing.assert_array_equal(parts.rgb_linear, whole.rgb_linear)
    np.testing.assert_array_equal(parts.alpha, whole.alpha)
    assert len(parts.layers) == 12
    for name, values in whole.layers.items():
        np.testing.assert_array_equal(parts.layers[name], values)
