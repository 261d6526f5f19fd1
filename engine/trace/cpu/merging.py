"""Gradients of two parts of a batch as one."""

from dataclasses import fields

import numpy as np

from engine.trace.protocol import GaussianGradients


def added(first: GaussianGradients, second: GaussianGradients) -> GaussianGradients:
    """The sum of the two, over the Gaussians that either has hit, in ascending order of id."""
    ids = np.union1d(first.ids, second.ids).astype(np.int32)
    sums = {}
    for field in fields(GaussianGradients):
        if field.name == "ids":
            continue
        one, other = getattr(first, field.name), getattr(second, field.name)
        total = np.zeros((len(ids), *one.shape[1:]), one.dtype)
        total[np.searchsorted(ids, first.ids)] = one
        total[np.searchsorted(ids, second.ids)] += other
        sums[field.name] = total
    return GaussianGradients(ids=ids, **sums)
