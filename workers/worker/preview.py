"""Preview images of a scene during its training, beside the photographs of the same view."""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from octasplat.engine.core.events import Event, EventListener
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.dataset import Dataset
from octasplat.engine.render.image_files import write_png
from octasplat.engine.render.renderer import background_color, render_rays
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.shading_factory import find_background, find_deferred

MAX_SIDE_PX = 320
MIN_SIDE_PX = 96
MATERIALS_SIDE_PX = 160
"""Materials send rays of their own, which take memory beside that of the training."""
PREVIEW_FILE = ".preview.png"
INTERVAL_SECONDS = 12.0
FIRST_INTERVAL_SECONDS = 4.0
"""The second picture comes so soon after the first, which shows little."""
MAX_TIME_FRACTION = 0.02
"""Pictures are made smaller until they take no more than this share of the time."""


@dataclass(frozen=True)
class PreviewWritten(Event):
    """A picture of view ``view`` after iteration ``step`` is at ``path``.

    Without a view it is a map of blocks: ``block_positions`` has the number of each, and where it is on the
    picture, 0 to 1 from the left and the top.
    """

    kind: ClassVar[str] = "preview_written"
    path: str
    step: int
    view: str | None
    block_positions: tuple[tuple[int, float, float], ...] = ()


class PreviewRenderer:
    """Renders one view of a training every few seconds, independent of its checkpoints.

    It traces rays with the training's own tracer between two iterations. That changes nothing in it, so the
    training is what it would be without.

    Args:
        run: the engine's output folder.
        background: behind the scene, by name.
        progress: told of pictures.
    """

    def __init__(self, run: Path, background: str, progress: EventListener) -> None:
        self._run = run
        self._background = background_color(background)
        self._listener = progress
        self._side_px = MAX_SIDE_PX
        self._next_at = -math.inf
        self._image_count = 0

    def __call__(self, iteration: int, dataset: Dataset, tracer: Tracer, shading: ShadingModel) -> None:
        """Render a preview if it is due."""
        began = time.monotonic()
        if began < self._next_at:
            return
        # A view that is held out shows how the scene looks where nothing was fitted.
        chosen = int((dataset.test_indices if len(dataset.test_indices) else dataset.train_indices)[0])
        materials = find_deferred(shading)
        # The background shades the materials before it, too.
        shown = find_background(shading) or materials or PLAIN_SHADING
        side_px = self._side_px if materials is None else min(self._side_px, MATERIALS_SIDE_PX)
        rays = grid_rays(dataset, chosen, side_px)
        image = render_rays(tracer, rays, self._background, shown)
        write_png(self._run / PREVIEW_FILE, image.rgb_srgb)
        self._listener(PreviewWritten(PREVIEW_FILE, iteration, dataset.views[chosen].name))
        spent = time.monotonic() - began
        self._image_count += 1
        wait = INTERVAL_SECONDS if self._image_count > 1 else FIRST_INTERVAL_SECONDS
        self._next_at = began + max(wait, 2 * spent)
        if spent > 0:
            # The time is that of the pixels, so that it grows with the square of the side.
            fitting_px = side_px * math.sqrt(MAX_TIME_FRACTION * INTERVAL_SECONDS / spent)
            self._side_px = int(min(MAX_SIDE_PX, max(MIN_SIDE_PX, fitting_px)))


def grid_rays(dataset: Dataset, view: int, side_px: int) -> ImageRays:
    """Return rays through evenly spaced pixels of a view.

    Args:
        dataset: the photographs.
        view: index of one of them.
        side_px: about the longer side of the grid; it is never finer than the photograph.
    """
    width, height = dataset.views[view].width_px, dataset.views[view].height_px
    scale = min(1.0, side_px / max(width, height))
    rows, columns = max(1, round(height * scale)), max(1, round(width * scale))
    y = ((np.arange(rows) + 0.5) * height / rows).astype(np.int64)
    x = ((np.arange(columns) + 0.5) * width / columns).astype(np.int64)
    yy, xx = np.meshgrid(y, x, indexing="ij")
    directions = dataset.rays(np.full(yy.size, view), yy.ravel(), xx.ravel()).directions_world
    origin_world = dataset.views[view].origin_world
    return ImageRays.from_directions(origin_world, directions.reshape(rows, columns, 3), dataset.near_world)
