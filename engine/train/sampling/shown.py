"""How much of the photographs shows anything: not masked, not wholly transparent."""

import numpy as np

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.train.sampling.pixel_sampler import PixelSampler, TrainingData

VALID_PIXEL_SAMPLES = 20_000
"""Pixels that are looked at, always the same ones: the share is right to 0.4 %."""


def valid_pixel_fraction(dataset: TrainingData) -> float:
    """Return the share of the training views' pixels that show something; at least that of one pixel.

    Raises:
        DatasetError: masks or alpha leave nothing of the training photographs.
    """
    sizes = np.array([[view.width_px, view.height_px] for view in dataset.views], np.int64)
    sampler = PixelSampler(dataset.train_indices, sizes)
    view, y, x = sampler.pixels(np.random.Generator(np.random.PCG64(0)), VALID_PIXEL_SAMPLES)
    _, alpha, weight = dataset.pixels(view, y, x)
    shown = int(((alpha > 0) & (weight > 0)).sum())
    if shown == 0 and _has_no_valid_pixel(dataset):
        raise DatasetError(
            "The training photographs show nothing: their masks or alpha leave no pixel. Masks are white "
            "where a pixel counts; invert them, or leave them out."
        )
    return max(1, shown) / VALID_PIXEL_SAMPLES


def _has_no_valid_pixel(dataset: TrainingData) -> bool:
    """Whether no pixel at all of the training views shows anything."""
    for index in dataset.train_indices.tolist():
        view = dataset.views[index]
        y, x = np.divmod(np.arange(view.width_px * view.height_px), view.width_px)
        _, alpha, weight = dataset.pixels(np.full(len(y), index), y, x)
        if ((alpha > 0) & (weight > 0)).any():
            return False
    return True
