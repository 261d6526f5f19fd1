"""Gaussians that a user would rather not see: faint, oversized, too near to a camera, and floaters."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from pydantic import BaseModel, ConfigDict, Field
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.scene.near import NearZones

WIDEST_LINK = 8.0
"""A Gaussian reaches no further than this many times the distance to its nearest neighbours, so that one huge
Gaussian does not hold everything together."""


class CleanOptions(BaseModel):
    """What to remove.

    Attributes:
        min_opacity: fainter ones.
        min_scale: those whose larger standard deviation is smaller, world units.
        max_scale: those whose larger standard deviation is larger, world units.
        floaters: isolated small groups.
        link: two neighbours belong together if their centres are no further apart than this many times the
            sum of their standard deviations.
        neighbours: how many nearest neighbours may be linked to.
        min_group: groups of fewer Gaussians than this are floaters.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    min_opacity: float = Field(default=0.01, ge=0.0, lt=1.0)
    min_scale: float = Field(default=0.0, ge=0.0)
    max_scale: float = Field(default=float("inf"), gt=0.0)
    floaters: bool = True
    link: float = Field(default=1.0, gt=0.0)
    neighbours: int = Field(default=12, ge=1, le=64)
    min_group: int = Field(default=20, ge=2)


@dataclass(frozen=True)
class CleanReport:
    """How many Gaussians were removed, each counted for the first reason that holds.

    Attributes:
        faint: below the least opacity.
        small: below the least scale.
        large: above the largest scale.
        near: nearer to a camera than what its photograph shows.
        floating: in groups too small.
        groups: number of such groups.
        kept: those that stay.
    """

    faint: int
    small: int
    large: int
    near: int
    floating: int
    groups: int
    kept: int


def clean(
    gaussians: FlatGaussians, options: CleanOptions, near_zones: NearZones | None = None
) -> tuple[Bool[np.ndarray, " n"], CleanReport]:
    """Which Gaussians stay, and why the others do not.

    Floaters are looked for among those that pass the thresholds and lie outside of ``near_zones``.
    """
    largest = gaussians.scales.max(axis=1, initial=0.0)
    faint = gaussians.opacities < options.min_opacity
    small = ~faint & (largest < options.min_scale)
    large = ~faint & (largest > options.max_scale)
    keep = ~(faint | small | large)
    near = np.zeros(len(gaussians), np.bool_)
    if near_zones is not None:
        near = keep & near_zones.holds(gaussians.means_world)
        keep &= ~near
    floating, groups = 0, 0
    if options.floaters and keep.any():
        rows = np.flatnonzero(keep)
        labels, sizes = linked_groups(gaussians.select(rows), options.link, options.neighbours)
        loose = sizes[labels] < min(options.min_group, sizes.max())
        keep[rows[loose]] = False
        floating = int(loose.sum())
        groups = int((sizes < min(options.min_group, sizes.max())).sum())
    report = CleanReport(
        int(faint.sum()),
        int(small.sum()),
        int(large.sum()),
        int(near.sum()),
        floating,
        groups,
        int(keep.sum()),
    )
    return keep, report


def linked_groups(gaussians: FlatGaussians, link: float, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """Groups of Gaussians that hang together: the group of each, and the sizes of the groups.

    What counts as near is measured by the Gaussians' own sizes, so that a coarse background holds together as
    well as a fine foreground.
    """
    count = min(neighbours + 1, len(gaussians))
    if count < 2:
        return np.zeros(len(gaussians), np.int64), np.full(min(1, len(gaussians)), len(gaussians))
    distances, near = KDTree(gaussians.means_world).query(gaussians.means_world, k=count)
    distances, near = distances[:, 1:], near[:, 1:]
    extents = gaussians.scales.max(axis=1).astype(np.float64)
    extents = np.minimum(extents, WIDEST_LINK * np.median(distances, axis=1))
    linked = distances <= link * (extents[:, None] + extents[near])
    rows = np.broadcast_to(np.arange(len(gaussians))[:, None], near.shape)[linked]
    graph = coo_array(
        (np.ones(len(rows), np.int8), (rows, near[linked])), shape=(len(gaussians), len(gaussians))
    )
    _, labels = connected_components(graph, directed=False)
    return labels, np.bincount(labels)
