"""Whether photographs that a scene is measured on were taken in the world of that scene."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from octasplat.engine.core.psnr import psnr
from octasplat.engine.dataset.model import Viewpoints
from octasplat.engine.dataset.view_frusta import ViewFrusta
from octasplat.engine.dataset.views_file import ViewsRecord
from octasplat.engine.evaluate.view_metrics import RenderedView
from octasplat.engine.gaussians.model import FlatGaussians

SAMPLES = 20_000
"""Gaussians that are looked for in the views."""
MIN_SEEN_SHARE = 1e-3
"""A view with fewer of them in its picture does not see the scene."""
MAX_DISTANCE_EXTENTS = 10.0
"""Cameras further from every camera of the run than this many scene extents lie beyond its surroundings."""
MIN_LOSS_DB = 3.0
"""Renders of another world are worse than those of the run's own views by more than this."""
ADVICE = (
    "name a folder whose model (sparse/0) stands in the world of the run, as one made of the photographs "
    "of both together"
)


class OtherWorldCheck:
    """Collects what speaks against photographs being of the scene's world.

    Args:
        folder: of the photographs, named in warnings.
        run: views of the run, about the scene's local origin; None where they are not known.
        run_psnr: mean of the run's own views in dB; None where it is not known.
    """

    def __init__(self, folder: Path, run: ViewsRecord | None, run_psnr: float | None) -> None:
        self._folder = folder
        self._run = run
        self._run_psnr = np.inf if run_psnr is None else run_psnr
        self._psnr: list[float] = []
        self._worse = 0

    def warn_of_cameras(self, others: Viewpoints, gaussians: FlatGaussians) -> str | None:
        """Return a warning where most cameras do not see the scene or are far from those of the run."""
        run = self._run
        far = None if run is None else far_views(run.viewpoints(None), others, run.extent_world)
        blind = blind_views(others, gaussians)
        count = len(others.views)
        if far is not None and 2 * int(far.sum()) > count:
            return (
                f"{int(far.sum())} of {count} cameras of {self._folder} lie more than "
                f"{MAX_DISTANCE_EXTENTS:g} scene extents from the cameras of the run, as those of another "
                f"world; {ADVICE}."
            )
        if 2 * int(blind.sum()) > count:
            return (
                f"{int(blind.sum())} of {count} cameras of {self._folder} do not see the scene, as those of "
                f"another world; {ADVICE}."
            )
        return None

    def add(self, view: RenderedView, psnr_db: float) -> None:
        """Compare the render of a view with a picture of one even color."""
        if not np.isnan(psnr_db):  # a mask left no pixel
            self._psnr.append(psnr_db)
            self._worse += psnr_db < even_color_psnr(view.reference, view.weight)

    def warn_of_renders(self) -> str | None:
        """Return a warning where most renders are further from their photographs than an even color is."""
        measured = len(self._psnr)
        if 2 * self._worse <= measured or np.mean(self._psnr) > self._run_psnr - MIN_LOSS_DB:
            return None  # or the run shows its own photographs no better
        return (
            f"{self._worse} of {measured} renders are further from the photographs of {self._folder} "
            f"than one even color is, so these are hardly of this scene in the world of the run; {ADVICE}."
        )


def far_views(run: Viewpoints, others: Viewpoints, extent_world: float) -> Bool[np.ndarray, " v"]:
    """Return which views stand more than ``MAX_DISTANCE_EXTENTS`` from every view of the run."""
    near, far = _origins(run), _origins(others)
    distances = np.linalg.norm(far[:, None] - near[None], axis=2).min(axis=1)
    return np.asarray(distances > MAX_DISTANCE_EXTENTS * extent_world)


def blind_views(views: Viewpoints, gaussians: FlatGaussians) -> Bool[np.ndarray, " v"]:
    """Return which views have next to no Gaussian in their picture."""
    # Each once where there are fewer Gaussians than samples
    rows: Int64[np.ndarray, " s"] = np.unique(np.linspace(0, len(gaussians) - 1, SAMPLES).astype(np.int64))
    points = gaussians.means_world[rows]
    seen = [
        ViewFrusta.from_views(views, np.array([index])).contains(points).mean()
        for index in range(len(views.views))
    ]
    return np.array(seen) < MIN_SEEN_SHARE


def even_color_psnr(
    reference_srgb: Float32[np.ndarray, "h w 3"], weight: Float32[np.ndarray, "h w"]
) -> float:
    """Return the PSNR in dB that a picture of the photograph's mean color would have."""
    total = max(float(weight.sum(dtype=np.float64)), 1e-12)
    mean = (reference_srgb * weight[..., None].astype(np.float64)).sum(axis=(0, 1)) / total
    return psnr(np.broadcast_to(mean.astype(np.float32), reference_srgb.shape), reference_srgb, weight)


def _origins(views: Viewpoints) -> Float64[np.ndarray, "v 3"]:
    return np.stack([view.origin_world for view in views.views])
