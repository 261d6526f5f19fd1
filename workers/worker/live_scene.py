"""The state of a training in 3D: a decimated scene and its cameras, written now and then."""

import math
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.core.events import Event, EventListener
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset import Dataset, SparsePoints, Viewpoints, load_dataset_model, scene_extent
from octasplat.engine.dataset.views_file import SplitViewpoints
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.train.initialization.initial_gaussians import gaussians_from_points

SCENE_FILE, VIEWS_FILE = ".live_scene.ply", ".live_views.json"
MAX_GAUSSIANS = 30_000
"""Most Gaussians of the file, which takes 68 bytes for each."""
INTERVAL_SECONDS = 15.0
AGE_FRACTION = 0.05
"""The older a training, the less it changes: the next file comes after this share of its time."""
MAX_TIME_FRACTION = 0.01
"""The files are written so rarely that they take no more than this share of the time."""
POINT_SHRINKAGE = 0.4
"""Sparse points are shown as discs of this share of their distance to their neighbors."""


@dataclass(frozen=True)
class LiveSceneWritten(Event):
    """The state after iteration ``step`` is at ``path``, its cameras are at ``views``."""

    kind: ClassVar[str] = "live_scene_written"
    path: str
    views: str
    step: int
    gaussians: int
    block_gaussians: tuple[int, ...] = ()
    """Of a scene in blocks how many Gaussians of the file are of each, one block after the other."""


class LiveSceneWriter:
    """Writes the state of a training between two iterations, independent of its checkpoints.

    Args:
        run: the engine's output folder.
        progress: told of files.
    """

    def __init__(self, run: Path, progress: EventListener) -> None:
        self._run = run
        self._listener = progress
        self._began_at = time.monotonic()
        self._next_at = -math.inf

    def write_points(self, scene: Path, model_folder: Path | None, model: str | None = None) -> None:
        """Write the sparse points of a model; nothing where it cannot be read, as the run says so itself.

        Args:
            scene: folder of the photographs.
            model_folder: of a model that was found for them.
            model: which of several models in ``scene`` the run takes.
        """
        try:
            found = load_dataset_model(scene, model_folder=model_folder, model=model, for_training=False)
            gaussians = _point_gaussians(found, found.points)
        except OctasplatError:
            return
        self._write(0, gaussians, found, set(found.held_out or ()))

    def write_blocks(self, step: int, cores: Sequence[FlatGaussians], views: SplitViewpoints) -> None:
        """Write the state of a scene in blocks at once, the Gaussians of each in its core."""
        shown = [heaviest(core, block_limit(len(cores))) for core in cores]
        counts = tuple(len(part) for part in shown)
        self._write(step, concatenate(shown), views, _held_out(views), counts)

    def write_block(self, step: int, core: FlatGaussians, count: int, views: SplitViewpoints) -> None:
        """Write what one of ``count`` blocks has learnt, the Gaussians in its core."""
        self._write(step, heaviest(core, block_limit(count)), views, _held_out(views))

    def __call__(self, iteration: int, dataset: Dataset, gaussians: FlatGaussians) -> None:
        """Write the state of the training if that is due."""
        began = time.monotonic()
        if began < self._next_at:
            return
        held_out = {dataset.views[i].name for i in dataset.test_indices}
        self._write(iteration, heaviest(gaussians, MAX_GAUSSIANS), dataset.viewpoints, held_out)
        spent = time.monotonic() - began
        wait = max(INTERVAL_SECONDS, AGE_FRACTION * (began - self._began_at), spent / MAX_TIME_FRACTION)
        self._next_at = began + wait

    def _write(
        self,
        step: int,
        gaussians: FlatGaussians,
        views: Viewpoints,
        held_out: Collection[str],
        block_gaussians: tuple[int, ...] = (),
    ) -> None:
        if len(gaussians) == 0:
            return
        write_gaussian_ply(gaussians, self._run / SCENE_FILE)
        write_json(self._run / VIEWS_FILE, views_content(views, held_out))
        self._listener(LiveSceneWritten(SCENE_FILE, VIEWS_FILE, step, len(gaussians), block_gaussians))


def block_limit(count: int) -> int:
    """Return the most Gaussians that are shown of each of ``count`` blocks."""
    return max(1, MAX_GAUSSIANS // count)


def heaviest(gaussians: FlatGaussians, count: int) -> FlatGaussians:
    """Return the ``count`` Gaussians with the most opacity times area, without view-dependent color."""
    rows: slice | np.ndarray = slice(None)
    if len(gaussians) > count:
        weights = gaussians.opacities * np.exp(gaussians.log_scales.sum(axis=1, dtype=np.float64))
        # argpartition leaves no order; sorted rows keep that of the Gaussians.
        rows = np.sort(np.argpartition(-weights, count)[:count])
    return FlatGaussians(
        means_world=gaussians.means_world[rows],
        quats_wxyz=gaussians.quats_wxyz[rows],
        log_scales=gaussians.log_scales[rows],
        opacity_logits=gaussians.opacity_logits[rows],
        sh=gaussians.sh[rows, :1],
    )


def views_content(views: Viewpoints, held_out: Collection[str]) -> dict[str, Any]:
    """Return cameras and poses as JSON values, in the form of ``views.json``."""
    return {
        "cameras": [
            {
                "model": camera.model,
                "params": list(camera.params),
                "width_px": camera.width_px,
                "height_px": camera.height_px,
            }
            for camera in views.cameras
        ],
        "views": [
            {
                "name": view.name,
                "camera": view.camera_index,
                "rotation_cam_from_world": view.rotation_cam_from_world.tolist(),
                "translation_cam_from_world": view.translation_cam_from_world.tolist(),
                "held_out": view.name in held_out,
            }
            for view in views.views
        ],
    }


def _held_out(views: SplitViewpoints) -> set[str]:
    return {views.views[index].name for index in views.test_indices}


def _point_gaussians(views: Viewpoints, points: SparsePoints) -> FlatGaussians:
    origins = np.stack([view.origin_world for view in views.views])
    found = gaussians_from_points(
        points.xyz_world,
        points.rgb_srgb,
        origins,
        extent=scene_extent(origins, points),
        limit=MAX_GAUSSIANS,
        opacity=0.95,
        rng=np.random.default_rng(0),
    )
    return FlatGaussians(
        means_world=found.means_world,
        quats_wxyz=found.quats_wxyz,
        log_scales=found.log_scales + np.float32(math.log(POINT_SHRINKAGE)),
        opacity_logits=found.opacity_logits,
        sh=found.sh[:, :1],
    )
