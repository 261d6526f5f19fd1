"""Gradients of several recordings of the same Gaussians, added up, and those of Gaussians that matter."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from octasplat.engine.trace.protocol import GaussianGradients


def add_gradients(parts: Sequence[GaussianGradients]) -> GaussianGradients:
    """The sum of at least one, for all Gaussians that any of them met; a single one is returned as it is."""
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
            total[place[part.ids]] += getattr(part, name)
        sums[name] = total
    return GaussianGradients(ids=ids, **sums)


def drop_low_weight(gradients: GaussianGradients, min_blend_weight: float) -> GaussianGradients:
    """Those of the Gaussians whose weights add up to ``min_blend_weight`` or more.

    Of all, the same object.
    """
    enough = gradients.weight_sums >= min_blend_weight
    if enough.all():
        return gradients
    return GaussianGradients(**{name: rows[enough] for name, rows in vars(gradients).items()})
