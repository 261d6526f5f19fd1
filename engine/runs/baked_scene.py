"""Scenes with one color for each Gaussian, as formats without harmonics need them, and its choice."""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.bake_color import fit_colors_to_cameras, with_constant_color
from octasplat.engine.render.shots import view_shots
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import CONFIG, run_min_view_distance, run_viewpoints
from octasplat.engine.surface.depth_cameras import cameras_around
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings

SIDE_PX = 160
MAX_VIEWS = 48


class BakedScene:
    """A scene whose single color per Gaussian is computed once, when it is first requested.

    Args:
        gaussians: the scene.
        run: the folder of the run that it is of; its training views are those for which the colors lose
            least. None takes cameras all around.
        threads: to use; 0 takes all.
        on_pass: called with (passes done, total); it may raise to stop.
        on_unknown: called with a sentence if the cameras of the run are not known any more, so that the
            colors of the constant harmonics stay.
    """

    def __init__(
        self,
        gaussians: FlatGaussians,
        run: Path | None,
        *,
        on_unknown: Callable[[str], None],
        threads: int = 0,
        on_pass: Callable[[int, int], None] = lambda _done, _total: None,
    ) -> None:
        self._gaussians, self._run, self._threads = gaussians, run, threads
        self._on_pass, self._on_unknown = on_pass, on_unknown

    @cached_property
    def gaussians(self) -> FlatGaussians:
        """Return the scene without harmonics beyond the constant one."""
        if self._gaussians.sh_degree == 0:
            return self._gaussians
        if self._run is None:
            # cameras all around, as nothing is known of the photographs
            settings, images = TraceSettings(), _rays_around(self._gaussians)
        else:
            try:
                settings, images = _of_run(self._run)
            except OctasplatError as error:
                self._on_unknown(f"The one color of each Gaussian is the constant harmonic: {error}")
                return with_constant_color(self._gaussians, self._gaussians.base_rgb_srgb)
        tracer = make_tracer(settings, threads=self._threads)
        colors = fit_colors_to_cameras(self._gaussians, tracer, images, on_pass=self._on_pass)
        return with_constant_color(self._gaussians, colors)


def _of_run(run: Path) -> tuple[TraceSettings, Sequence[Callable[[], ImageRays]]]:
    config = read_config(run / CONFIG)
    viewpoints = run_viewpoints(run, max_side=SIDE_PX)
    near = run_min_view_distance(run, viewpoints)
    shots = view_shots(viewpoints, _spread_views(viewpoints.train_indices), near)
    return config.train.trace, [shot.rays for shot in shots]


def _rays_around(gaussians: FlatGaussians) -> Sequence[Callable[[], ImageRays]]:
    return [camera.rays for camera in cameras_around(gaussians, SIDE_PX, MAX_VIEWS)]


def _spread_views(indices: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " m"]:
    """Return at most ``MAX_VIEWS`` of the views, spread evenly."""
    count = min(len(indices), MAX_VIEWS)
    return indices[np.linspace(0, len(indices) - 1, count).round().astype(np.int64)]
