"""A run, and its steps."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from octasplat.engine.core.errors import CancelledError, ExportError
from octasplat.engine.core.events import EventListener
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.views_file import ViewsRecord
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.georeference.request import GeoreferenceRequest
from octasplat.engine.pipeline.block_request import BlockRequest
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.config import TrainConfig, with_depth_weight

OnStep = Callable[[int, Dataset, Tracer, ShadingModel, FlatGaussians], None]
"""Called between two iterations of a training: iterations done, photographs, tracer, shading, Gaussians."""


@dataclass
class ReconstructionRun:
    """State that the steps of a run share.

    Attributes:
        scene: folder of the photographs.
        output: folder of the results.
        config: all settings.
        threads: for everything; 0 means all cores.
        progress: called with each event.
        should_stop: asked now and then; True stops the run after a checkpoint.
        on_step: called with the training after each iteration.
        recorded: the photographs of a run that goes on; None for a new one.
        blocks: how to train in blocks; None trains the scene as a whole.
        check_views: called with the photographs that were found, before decoding; raises to reject them.
        georeference: what the georeference of a new run is found from.
        given: names of the settings that were given, see
            :func:`octasplat.engine.runs.config.given_settings`; None where that is not known.
    """

    scene: Path
    output: Path
    config: ReconstructionConfig
    threads: int
    progress: EventListener
    should_stop: Callable[[], bool]
    on_step: OnStep | None = None
    recorded: ViewsRecord | None = None
    blocks: BlockRequest | None = None
    check_views: Callable[[ViewsRecord], None] | None = None
    georeference: GeoreferenceRequest | None = None
    given: tuple[str, ...] | None = None
    _dataset: Dataset | None = None

    @property
    def dataset(self) -> Dataset:
        """Return the photographs, which a step has opened."""
        assert self._dataset is not None, "a step asks for the photographs before they are open"
        return self._dataset

    @dataset.setter
    def dataset(self, dataset: Dataset) -> None:
        self._dataset = dataset

    @property
    def train_config(self) -> TrainConfig:
        """Return the settings of the training of these photographs."""
        return with_depth_weight(self.config.train, has_depth_maps=self.dataset.has_known_distances)


@runtime_checkable
class Step(Protocol):
    """A part of a run.

    Attributes:
        is_needed_later: whether the steps after it can do nothing if it fails.
    """

    is_needed_later: bool

    def is_done(self, run: ReconstructionRun) -> bool:
        """Return whether the step's result exists."""

    def __call__(self, run: ReconstructionRun) -> None:
        """Produce the step's result."""


def run_steps(steps: Sequence[Step], run: ReconstructionRun) -> None:
    """Execute all steps whose results are missing; if an optional one fails, the others still run.

    Raises:
        OctasplatError: as the step that failed first does.
    """
    for place, step in enumerate(steps):
        try:
            if not step.is_done(run):
                step(run)
        except CancelledError:
            raise
        except Exception:
            if not step.is_needed_later:
                with suppress(ExportError):  # the first failure is told, not that of a later step
                    run_steps(steps[place + 1 :], run)
            raise
