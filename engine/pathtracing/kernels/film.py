"""Sums over the paths of each pixel."""

from octasplat.engine.core.compilation import kernel


@kernel(_nrt=False, error_model="numpy")
def accumulate_pixels(values, factors, paths_per_pixel, pixels, sums):
    """Add to the rows ``pixels`` of ``sums`` those of ``values``, ``paths_per_pixel`` a pixel, times ``factors``.

    All is summed in float64, one after the other. Without factors (no rows at all) values count as they are.
    """
    for i in range(len(pixels)):
        for channel in range(values.shape[1]):
            total = 0.0
            for k in range(i * paths_per_pixel, (i + 1) * paths_per_pixel):
                total += float(values[k, channel]) * (factors[k] if len(factors) else 1.0)
            sums[pixels[i], channel] += total
