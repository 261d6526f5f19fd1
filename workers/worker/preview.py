"""Small pictures of a scene in the making, beside the photographs they answer to."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from engine.config import ReconstructionConfig
from engine.events import CheckpointWritten, Event, Listener, StageFinished
from engine.gaussians.model import FlatGaussians
from engine.render.images import write_png
from engine.render.jobs import view_shots
from engine.render.renderer import background_colour, render_rays
from engine.scene import SceneModel, load_scene, scene_extent, split_views
from engine.trace.make import make_tracer

SIDE_PX = 320
FILE = ".preview.png"
_SHARE_OF_TIME = 0.02
"""Most of the training's time that pictures may take."""


@dataclass(frozen=True)
class PreviewWritten(Event):
    """A picture of view ``view`` after iteration ``step`` is at ``path``."""

    kind: ClassVar[str] = "preview_written"
    path: str
    step: int
    view: str


class Previews:
    """A listener that renders one view after checkpoints, as often as it takes no more than 2 % of the time.

    It reads the checkpoint and has a tracer of its own, so the training is what it would be without.

    Args:
        scene: the photographs.
        run: the engine's output folder.
        config: the run's settings.
        listener: told of pictures.
    """

    def __init__(self, scene: Path, run: Path, config: ReconstructionConfig, listener: Listener) -> None:
        self._scene = scene
        self._run = run
        self._config = config
        self._listener = listener
        self._began = time.monotonic()
        self._spent = 0.0
        self._model: SceneModel | None = None

    def __call__(self, event: Event) -> None:
        """Hear of a checkpoint."""
        if isinstance(event, StageFinished) and event.stage == "load":
            self._began = time.monotonic()
        if not isinstance(event, CheckpointWritten):
            return
        began = time.monotonic()
        if self._spent <= _SHARE_OF_TIME * (began - self._began) or self._spent == 0:
            self._render(Path(event.path), event.iteration)
            self._spent += time.monotonic() - began

    def _render(self, checkpoint: Path, iteration: int) -> None:
        config = self._config
        if self._model is None:
            self._model = load_scene(self._scene, max_side=SIDE_PX)
        model = self._model
        train, test = split_views([view.name for view in model.views], config.test_every, config.held_out)
        with checkpoint.open("rb") as handle, np.load(handle, allow_pickle=False) as archive:
            arrays = {n.removeprefix("gaussians."): archive[n] for n in archive.files if n.startswith("gaus")}
        gaussians = FlatGaussians(**arrays)
        extent = scene_extent(np.stack([model.views[i].origin_world for i in train]), model.points)
        tracer = make_tracer(config.train.trace, threads=1)
        tracer.build(gaussians)
        chosen = test if len(test) else train
        shot = view_shots(model, chosen[:1], config.train.near * extent)[0]
        image = render_rays(tracer, shot.rays(), background_colour(config.evaluate_background))
        write_png(self._run / FILE, image.rgb_srgb)
        self._listener(PreviewWritten(FILE, iteration, model.views[chosen[0]].name))
