"""How much of the photographs shows anything: not masked, not wholly transparent."""

import numpy as np

from octasplat.engine.train.pixel_sampler import PixelSampler, TrainingData

SAMPLES = 20_000
"""Pixels that are looked at, always the same ones: the share is right to 0.4 %."""


def shown_share(dataset: TrainingData) -> float:
    """Share of the training views' pixels that show something; at least that of one pixel looked at."""
    sizes = np.array([[view.width_px, view.height_px] for view in dataset.views], np.int64)
    sampler = PixelSampler(dataset.train_indices, sizes)
    view, y, x = sampler.pixels(np.random.Generator(np.random.PCG64(0)), SAMPLES)
    _, alpha, weight = dataset.pixels(view, y, x)
    return max(1, int(((alpha > 0) & (weight > 0)).sum())) / SAMPLES
