"""Sums of gradients over several recordings, and their restriction to relevant Gaussians."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from octasplat.engine.trace.protocol import GaussianGradients


def add_gradients(parts: Sequence[GaussianGradients]) -> GaussianGradients:
    """Return the sum of at least one, for all Gaussians that any of them hit; a single one as it is."""
    if len(parts) == 1:
        return parts[0]
    met = np.zeros(1 + max(int(part.ids.max(initial=-1)) for part in parts), bool)
    for part in parts:
        met[part.ids] = True
    ids = np.flatnonzero(met).astype(parts[0].ids.dtype)
    place = np.cumsum(met) - 1
    sums = {}
    for name in (field.name for field in fields(GaussianGradients) if field.name != "ids"):
        first = getattr(parts[0], name)
        total = np.zeros((len(ids), *first.shape[1:]), first.dtype)
        for part in parts:
            # ids of a part are unique, so that no addition is lost
            total[place[part.ids]] += getattr(part, name)
        sums[name] = total
    return GaussianGradients(ids=ids, **sums)


def drop_low_weight(gradients: GaussianGradients, min_blend_weight: float) -> GaussianGradients:
    """Return the gradients of Gaussians of at least ``min_blend_weight``; the same object if that is all."""
    enough = gradients.weight_sums >= min_blend_weight
    if enough.all():
        return gradients
    return GaussianGradients(**{name: rows[enough] for name, rows in vars(gradients).items()})
