"""How well each photograph fits the scene, and those that do not fit what the others show.

A photograph whose pose is wrong is rendered as something else, whether it was trained on or not, while its
neighbours are rendered well.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from octasplat.engine.core.color import composite_over
from octasplat.engine.core.progress import ProgressCallback, no_progress
from octasplat.engine.core.psnr import fit_color, psnr
from octasplat.engine.dataset import DatasetView
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.sampling.pixel_sampler import TrainingData
from octasplat.engine.train.views.view_grids import render_grids

GRID_TILES = 3
"""So many tiles each way of a view are measured.

See :func:`octasplat.engine.train.sampling.batches.grid_pixels`.
"""
MIN_VIEWS = 6
"""Among fewer views nobody can say which of them is odd."""
NEIGHBORS = 8
MAX_DISTANCES = 1 << 22
"""Distances between views are found in blocks of so many; 2,048 views fit into one."""
MAX_PSNR_DB = 100.0
"""A view that is shown without an error counts as so many."""
OUTLIER_MARGIN_DB, OUTLIER_SIGMAS = 3.0, 5.0
"""A view that is so much worse than those around it, also in robust standard deviations, is misplaced."""
MAX_EXCLUDED_FRACTION = 0.25
"""No larger share of the training views is left out."""
MISPLACED_MARGIN_DB, MISPLACED_SIGMAS = 2.0, 3.0
"""The same after a short training: less, as matches have the last word on poses."""
MAX_MISPLACED_VIEWS, MAX_MISPLACED_FRACTION = 20, 0.25
"""No more views are in doubt, nor a larger share of all; the worst are."""


@dataclass(frozen=True, eq=False)
class ViewPsnr:
    """PSNR of views, each on a fixed grid of its pixels.

    Attributes:
        indices: the views.
        psnr: dB; not-a-number where a mask leaves nothing.
        psnr_colour_corrected: dB, after the gain and offset of each channel that fit best.
    """

    indices: Int64[np.ndarray, " v"]
    psnr: Float64[np.ndarray, " v"]
    psnr_colour_corrected: Float64[np.ndarray, " v"]


def measure_views(
    dataset: TrainingData,
    indices: Int64[np.ndarray, " v"],
    background_srgb: Float32[np.ndarray, "3"],
    tracer: Tracer,
    shading: ShadingModel,
    progress: ProgressCallback = no_progress,
) -> ViewPsnr:
    """Measure the Gaussians that ``tracer`` holds on the views ``indices``; changes nothing.

    ``progress`` is told of the views that are measured, some at a time.
    """
    plain, corrected = [], []
    for grids in render_grids(
        dataset, indices, background_srgb, tracer, shading, tiles=GRID_TILES, exposed=True
    ):
        rgb, alpha, weight = dataset.pixels(*grids.pixels)
        target = composite_over(rgb, alpha, background_srgb).reshape(grids.rgb_srgb.shape)
        is_valid = (weight > 0).astype(np.float32).reshape(len(target), -1)
        for rendered, photograph, valid in zip(grids.rgb_srgb, target, is_valid, strict=True):
            plain.append(psnr(rendered, photograph, valid))
            corrected.append(psnr(fit_color(rendered, photograph, valid), photograph, valid))
        progress(len(plain), len(indices))
    return ViewPsnr(indices, *(np.minimum(values, MAX_PSNR_DB) for values in (plain, corrected)))


def find_outlier_views(
    measured: ViewPsnr,
    views: Sequence[DatasetView],
    train_indices: Int64[np.ndarray, " t"],
    margin_db: float = OUTLIER_MARGIN_DB,
    sigmas: float = OUTLIER_SIGMAS,
) -> Int64[np.ndarray, " m"]:
    """Return the views that are rendered far worse than the training views around them, worst first.

    Each is compared with the middle of its neighbours, so that a part of the scene that is hard to learn is
    not taken for wrong poses; how much that difference varies among the training views says what is far.
    Held-out views are as a rule worse than their neighbours and are taken as such. Exposure does not count.

    Args:
        measured: of views, training views among them.
        views: all views of the dataset.
        train_indices: views that are trained on.
        margin_db: how much worse at least.
        sigmas: how many robust standard deviations are far.
    """
    known = np.isfinite(measured.psnr_colour_corrected)
    indices, psnr = measured.indices[known], measured.psnr_colour_corrected[known]
    trained = np.isin(indices, train_indices)
    if int(trained.sum()) < MIN_VIEWS:
        return np.zeros(0, np.int64)
    low = np.zeros(len(indices), np.bool_)
    below = np.zeros(len(indices))
    for _ in range(2):  # the second time without those that the first found as neighbours
        above = psnr - _neighborhood_median(indices, psnr, trained & ~low, views)
        usual = float(np.median(above[trained]))
        # MAD to standard deviation of a normal distribution
        sigma = 1.4826 * float(np.median(np.abs(above[trained] - usual)))
        below = usual - above
        if not trained.all():
            # held-out views are worse as a rule: only the excess counts
            below[~trained] -= max(0.0, float(np.median(below[~trained])))
        low = below > max(margin_db, sigmas * sigma)
    worst_first = np.argsort(-below, kind="stable")
    return indices[worst_first[low[worst_first]]]


def find_misplaced_views(
    dataset: TrainingData,
    background_srgb: Float32[np.ndarray, "3"],
    tracer: Tracer,
    shading: ShadingModel,
) -> Int64[np.ndarray, " d"]:
    """Return views, held-out ones too, that fit the others so badly that their poses are in doubt; in order.

    Args:
        dataset: the photographs.
        background_srgb: what lies behind them.
        tracer: holds the Gaussians of a short training.
        shading: of that training.
    """
    measured = measure_views(dataset, np.arange(len(dataset.views)), background_srgb, tracer, shading)
    doubtful = find_outlier_views(
        measured,
        dataset.views,
        dataset.train_indices,
        margin_db=MISPLACED_MARGIN_DB,
        sigmas=MISPLACED_SIGMAS,
    )
    max_count = min(MAX_MISPLACED_VIEWS, int(MAX_MISPLACED_FRACTION * len(dataset.views)))
    return np.sort(doubtful[:max_count])


def _neighborhood_median(
    indices: Int64[np.ndarray, " v"],
    psnr: Float64[np.ndarray, " v"],
    counts: Bool[np.ndarray, " v"],
    views: Sequence[DatasetView],
) -> Float64[np.ndarray, " v"]:
    """Return the middle of the PSNR of the nearest views of each among those that count, dB.

    Near are views from near places that look the same way. Of many views only a block of distances is held
    at once, and the usual distance is that of evenly spaced views from all others.
    """
    origins = np.stack([views[i].origin_world for i in indices.tolist()])
    forward = np.stack([views[i].rotation_cam_from_world[2] for i in indices.tolist()])
    total = len(origins)
    rows = max(1, MAX_DISTANCES // total)
    sample = np.unique(np.linspace(0, total - 1, min(rows, total)).astype(np.int64))
    usual_distance = max(float(np.median(_distances(origins[sample], origins))), 1e-12)
    neighbor_count = min(NEIGHBORS, int(counts.sum()) - 1)
    result = np.empty(total)
    for start in range(0, total, rows):
        part = slice(start, start + rows)
        distances = _distances(origins[part], origins) / usual_distance + (1 - forward[part] @ forward.T)
        distances[:, ~counts] = np.inf
        # a view is not its own neighbor
        distances[np.arange(len(distances)), np.arange(total)[part]] = np.inf
        nearest = np.argsort(distances, axis=1, kind="stable")[:, :neighbor_count]
        result[part] = np.median(psnr[nearest], axis=1)
    return result


def _distances(
    some: Float64[np.ndarray, "s 3"], others: Float64[np.ndarray, "v 3"]
) -> Float64[np.ndarray, "s v"]:
    return np.asarray(np.linalg.norm(some[:, None] - others, axis=2))


@dataclass(frozen=True)
class TrainingViewReport:
    """PSNR of the training views at the end, see :class:`ViewPsnr`.

    Attributes:
        psnr: dB, by name, of the views that were trained on to the end.
        misfits: names of views that do not fit the others, worst first, held-out ones and those left out too.
        left_out: names of those that were left out of the training.
    """

    psnr: dict[str, float]
    misfits: tuple[str, ...]
    left_out: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
        """Return a JSON-ready record, with the mean and the worst view."""
        known = {name: round(value, 4) for name, value in self.psnr.items() if np.isfinite(value)}
        worst = min(known, key=lambda name: known[name], default=None)
        return {
            "psnr": float(np.mean(list(known.values()))) if known else None,
            "worst": worst,
            "worst_psnr": None if worst is None else known[worst],
            "misfits": list(self.misfits),
            "left_out": list(self.left_out),
            "views": known,
        }

    def warning(self) -> str | None:
        """Return a warning that names photographs that do not fit, or None."""
        loose = [name for name in self.misfits if name not in self.left_out]
        if not loose:
            return None
        which = "This photograph does" if len(loose) == 1 else f"These {len(loose)} photographs do"
        its = "its pose" if len(loose) == 1 else "their poses"
        return (
            f"{which} not fit the others; {its} may be wrong, or the picture blurred: {', '.join(loose)}. "
            "Given poses that are wrong come right with the setting repair_poses, or where all are found "
            "anew (--poses auto); exclude_outlier_views trains without such photographs."
        )


class OutlierDetector:
    """Looks for views that do not fit.

    Args:
        dataset: the photographs.
        background_srgb: what is behind them.
    """

    def __init__(self, dataset: TrainingData, background_srgb: Float32[np.ndarray, "3"]) -> None:
        self._dataset = dataset
        self._background_srgb = background_srgb

    def find(
        self, tracer: Tracer, shading: ShadingModel, left_out: Int64[np.ndarray, " k"]
    ) -> Int64[np.ndarray, " m"]:
        """Return training views to exclude besides ``left_out``, by how ``tracer`` shows them."""
        train = self._dataset.train_indices
        used = np.setdiff1d(train, left_out)
        measured = measure_views(self._dataset, used, self._background_srgb, tracer, shading)
        # views left out before count towards the limit
        max_more = int(MAX_EXCLUDED_FRACTION * len(train)) - len(left_out)
        return np.sort(find_outlier_views(measured, self._dataset.views, used)[: max(0, max_more)])

    def report(
        self,
        tracer: Tracer,
        shading: ShadingModel,
        left_out: Int64[np.ndarray, " m"],
        progress: ProgressCallback = no_progress,
    ) -> TrainingViewReport:
        """Return how well the finished Gaussians, which ``tracer`` holds, show all views not left out."""
        dataset = self._dataset
        train_used = np.setdiff1d(dataset.train_indices, left_out)
        indices = np.concatenate([train_used, dataset.test_indices])
        measured = measure_views(dataset, indices, self._background_srgb, tracer, shading, progress)
        outliers = find_outlier_views(measured, dataset.views, train_used)
        names = [view.name for view in dataset.views]
        psnr = dict(zip(measured.indices.tolist(), measured.psnr.tolist(), strict=True))
        return TrainingViewReport(
            psnr={names[i]: psnr[i] for i in train_used.tolist()},
            misfits=tuple(names[i] for i in [*outliers.tolist(), *left_out.tolist()]),
            left_out=tuple(names[i] for i in left_out.tolist()),
        )
