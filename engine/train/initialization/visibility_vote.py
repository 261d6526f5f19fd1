"""The vote of the photographs on points lifted from one of them."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Int64

from octasplat.engine.dataset import Dataset
from octasplat.engine.train.initialization.patch_matching import ExposedPhotographs, is_inside, project
from octasplat.engine.train.initialization.plane_sweep_points import PlaneSweepPoints

VOTING_VIEWS = 24
"""Views that vote on each point, spread evenly over all, or nearest to its own where few of these look."""
MIN_VOTERS = 3
"""Jurors that must look towards a point."""
MAX_VOTE_DIFFERENCE = 0.12
"""Largest mean difference of color, in display values, of a view that agrees."""
MIN_VOTE_FRACTION = 0.3
"""Share of the views looking there that must agree: a point in free space hides other things in most."""
SWEEP_MAX_VOTE_DIFFERENCE, SWEEP_MIN_VOTE_FRACTION = 0.1, 0.4
"""The same of points at depths that no other point suggested."""


def passes_vote(
    photographs: ExposedPhotographs,
    points: PlaneSweepPoints,
    own_view: Int64[np.ndarray, " n"],
    pool: ThreadPoolExecutor,
) -> Bool[np.ndarray, " n"]:
    """Return whether enough of the views that look towards each point show its color there."""
    limits = np.where(points.swept, SWEEP_MAX_VOTE_DIFFERENCE, MAX_VOTE_DIFFERENCE)
    majority = np.where(points.swept, SWEEP_MIN_VOTE_FRACTION, MIN_VOTE_FRACTION)
    agree, looking = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    dataset = photographs.dataset
    train, xyz_world = dataset.train_indices, points.xyz_world.astype(np.float64)

    def vote(juror: tuple[int, np.ndarray | slice]) -> tuple[np.ndarray, np.ndarray]:
        index, rows = juror
        image_px, depth = project(dataset, index, xyz_world[rows])
        inside = np.flatnonzero(is_inside(dataset, index, image_px) & (depth > 0))
        pixel = np.floor(image_px[inside]).astype(np.int64)
        rgb, _, _ = photographs.pixels(np.full(len(inside), index), pixel[:, 1], pixel[:, 0])
        ids = inside if isinstance(rows, slice) else rows[inside]
        return ids, np.abs(rgb - points.rgb_srgb[ids]).mean(axis=1) < limits[ids]

    jury = train[np.unique(np.linspace(0, len(train) - 1, VOTING_VIEWS).astype(np.int64))].tolist()
    # the pool keeps the order: sums are the same on any number of threads
    for ids, agrees in pool.map(vote, [(index, slice(None)) for index in jury]):
        looking[ids] += 1
        agree[ids] += agrees
    if len(jury) < len(train):
        unseen = np.flatnonzero(looking < MIN_VOTERS)
        looking[unseen] = agree[unseen] = 0  # of these only their nearest views vote
        for ids, agrees in pool.map(vote, _voting_views(dataset, own_view, unseen)):
            looking[ids] += 1
            agree[ids] += agrees
    return np.asarray(agree >= majority * np.maximum(looking, 1))


def _voting_views(
    dataset: Dataset, own_view: Int64[np.ndarray, " n"], rows: Int64[np.ndarray, " k"]
) -> list[tuple[int, Int64[np.ndarray, "_"]]]:
    """Return training views and the rows of points that they vote on: those of the nearest other views."""
    train = dataset.train_indices
    centres = np.stack([dataset.views[i].origin_world for i in train.tolist()])
    jurors = []
    for index in np.unique(own_view[rows]).tolist():
        away = np.linalg.norm(centres - dataset.views[index].origin_world, axis=1)
        near = train[np.argsort(away, kind="stable")[: VOTING_VIEWS + 1]]
        mine = rows[own_view[rows] == index]
        jurors += [(juror, mine) for juror in near.tolist() if juror != index]
    return jurors
