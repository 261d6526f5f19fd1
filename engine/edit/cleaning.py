"""Removal of Gaussians that disturb: faint, oversized, too near to a camera, or floaters."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float32
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from octasplat.engine.dataset.camera_clearance import CameraClearance
from octasplat.engine.edit.edit_options import CleanupOptions
from octasplat.engine.edit.reports import CleanReport
from octasplat.engine.gaussians.model import FlatGaussians

MAX_LINK = 8.0
"""A Gaussian reaches no further than this many times the distance to its nearest neighbours, so that one huge
Gaussian does not hold everything together."""


def clean(
    gaussians: FlatGaussians,
    options: CleanupOptions,
    near_zones: CameraClearance | None = None,
    seen: Callable[[Float32[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]] | None = None,
) -> tuple[Bool[np.ndarray, " n"], CleanReport]:
    """Return a mask of the Gaussians to keep, and counts of the others by reason.

    Floaters are looked for among those that pass the thresholds, lie outside of ``near_zones`` and for whose
    centres ``seen`` is true.
    """
    largest = gaussians.scales.max(axis=1, initial=0.0)
    faint = gaussians.opacities < options.min_opacity
    small = ~faint & (largest < options.min_scale)
    large = ~faint & (largest > (np.inf if options.max_scale is None else options.max_scale))
    keep = ~(faint | small | large)
    near = np.zeros(len(gaussians), np.bool_)
    if near_zones is not None:
        near = keep & near_zones.contains(gaussians.means_world)
        keep &= ~near
    unseen = keep & ~seen(gaussians.means_world) if seen is not None else np.zeros(len(gaussians), np.bool_)
    keep &= ~unseen
    floating, groups = 0, 0
    if options.floaters and keep.any():
        rows = np.flatnonzero(keep)
        labels, sizes = linked_groups(gaussians.select(rows), options.link, options.neighbors)
        # The largest group stays, however small it is.
        loose = sizes[labels] < min(options.min_group, sizes.max())
        keep[rows[loose]] = False
        floating = int(loose.sum())
        groups = int((sizes < min(options.min_group, sizes.max())).sum())
    report = CleanReport(
        faint=int(faint.sum()),
        small=int(small.sum()),
        large=int(large.sum()),
        near=int(near.sum()),
        unseen=int(unseen.sum()),
        floating=floating,
        groups=groups,
        kept=int(keep.sum()),
    )
    return keep, report


def linked_groups(gaussians: FlatGaussians, link: float, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the connected group of each Gaussian, and the groups' sizes.

    What counts as near is measured by the Gaussians' own sizes, so that a coarse background holds together as
    well as a fine foreground.
    """
    count = min(neighbours + 1, len(gaussians))
    if count < 2:
        return np.zeros(len(gaussians), np.int64), np.full(min(1, len(gaussians)), len(gaussians))
    distances, near = KDTree(gaussians.means_world).query(gaussians.means_world, k=count)
    distances, near = distances[:, 1:], near[:, 1:]  # without the nearest, the Gaussian itself
    extents = gaussians.scales.max(axis=1).astype(np.float64)
    extents = np.minimum(extents, MAX_LINK * np.median(distances, axis=1))
    linked = distances <= link * (extents[:, None] + extents[near])
    rows = np.broadcast_to(np.arange(len(gaussians))[:, None], near.shape)[linked]
    graph = coo_array(
        (np.ones(len(rows), np.int8), (rows, near[linked])), shape=(len(gaussians), len(gaussians))
    )
    _, labels = connected_components(graph, directed=False)
    return labels, np.bincount(labels)
