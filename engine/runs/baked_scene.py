"""Scenes with one color for each Gaussian, as formats without harmonics need them, and its choice."""

import hashlib
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.errors import DiskFullError, OctasplatError
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.bake_color import fit_colors_to_cameras, with_constant_color
from octasplat.engine.render.shots import view_shots
from octasplat.engine.runs.config import read_config
from octasplat.engine.runs.run_folder import CACHE, CONFIG, run_min_view_distance, run_viewpoints
from octasplat.engine.surface.depth_cameras import cameras_around
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceSettings

SIDE_PX = 160
MAX_VIEWS = 48
COLORS = "camera_colors.npz"
"""In the cache of a run: the colors of its scene, so that no later export traces rays for them."""
COLORS_VERSION = 1
"""Raise it when the same run would get other colors."""


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
            colors = self._fit(TraceSettings(), _rays_around(self._gaussians))
            return with_constant_color(self._gaussians, colors)
        try:
            settings, images, key = _of_run(self._run, self._gaussians)
        except OctasplatError as error:
            self._on_unknown(f"The one color of each Gaussian is the constant harmonic: {error}")
            return with_constant_color(self._gaussians, self._gaussians.base_rgb_srgb)
        kept = self._run / CACHE / COLORS
        found = _read_colors(kept, key, len(self._gaussians))
        if found is None:
            found = self._fit(settings, images)
            _keep_colors(kept, key, found)
        return with_constant_color(self._gaussians, found)

    def _fit(
        self, settings: TraceSettings, images: Sequence[Callable[[], ImageRays]]
    ) -> Float32[np.ndarray, "n 3"]:
        tracer = make_tracer(settings, threads=self._threads)
        return fit_colors_to_cameras(self._gaussians, tracer, images, on_pass=self._on_pass)


def _of_run(
    run: Path, gaussians: FlatGaussians
) -> tuple[TraceSettings, Sequence[Callable[[], ImageRays]], str]:
    """Return the settings, the rays of the cameras, and a digest of all that the colors depend on."""
    settings = read_config(run / CONFIG).train.trace
    viewpoints = run_viewpoints(run, max_side=SIDE_PX)
    near = run_min_view_distance(run, viewpoints)
    views = _spread_views(viewpoints.train_indices)
    total = hashlib.sha256(f"{COLORS_VERSION} {settings.model_dump_json()} {near!r}".encode())
    for index in views:
        view = viewpoints.views[index]
        camera = viewpoints.cameras[view.camera_index]
        total.update(repr((view.width_px, view.height_px, camera)).encode())
        total.update(view.rotation_cam_from_world.tobytes())
        total.update(view.translation_cam_from_world.tobytes())
    for array in (
        gaussians.means_world,
        gaussians.quats_wxyz,
        gaussians.log_scales,
        gaussians.opacity_logits,
        gaussians.sh,
    ):
        total.update(array.tobytes())
    shots = view_shots(viewpoints, views, near)
    return settings, [shot.rays for shot in shots], total.hexdigest()


def _read_colors(path: Path, key: str, count: int) -> Float32[np.ndarray, "n 3"] | None:
    """Return the colors that were kept under the key, or None."""
    try:
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as kept:
            colors = kept["colors"] if str(kept["key"]) == key else None
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        return None
    is_whole = colors is not None and colors.shape == (count, 3) and colors.dtype == np.float32
    return colors if is_whole else None


def _keep_colors(path: Path, key: str, colors: Float32[np.ndarray, "n 3"]) -> None:
    """Keep the colors for later exports, where the folder of the run can be written."""
    with suppress(OSError, DiskFullError), atomic_replace(path) as temporary:
        np.savez(temporary, key=np.array(key), colors=colors)


def _rays_around(gaussians: FlatGaussians) -> Sequence[Callable[[], ImageRays]]:
    return [camera.rays for camera in cameras_around(gaussians, SIDE_PX, MAX_VIEWS)]


def _spread_views(indices: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " m"]:
    """Return at most ``MAX_VIEWS`` of the views, spread evenly."""
    count = min(len(indices), MAX_VIEWS)
    return indices[np.linspace(0, len(indices) - 1, count).round().astype(np.int64)]
