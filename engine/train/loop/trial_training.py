"""Trainings that are thrown away: one for a coarse scene, one for the pace of this machine."""

import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.threads import use_threads
from octasplat.engine.dataset import Dataset
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.config import Background, TrainConfig
from octasplat.engine.train.initialization.initial_gaussians import initial_train_state
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer

COARSE_ITERATIONS = 200
WARM_UP_ITERATIONS, TIMED_ITERATIONS = 10, 50
"""Iterations before the clock starts, as kernels compile and caches fill, and those that it counts."""
_COARSE_SETTINGS: dict[str, object] = {
    "iterations": COARSE_ITERATIONS,
    "max_gaussians": 10_000,
    "rays_per_batch": 8192,
    "sh_degree": 0,
    "exposure": False,
    "early_stopping_db": 0.0,
    "probe_rays": 256,
}


def train_coarse_scene(
    dataset: Dataset,
    *,
    background: Background,
    seed: int,
    threads: int,
    should_stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int], None] = lambda _done: None,
) -> tuple[Tracer, ShadingModel]:
    """Train a few thousand Gaussians for a few seconds, which show what the photographs have in common.

    Args:
        dataset: the photographs.
        background: what lies behind everything.
        seed: of everything random.
        threads: of the training; 0 means all cores.
        should_stop: asked between iterations.
        progress: called with the iterations done, of :data:`COARSE_ITERATIONS`.

    Returns:
        A tracer that holds the Gaussians, and their shading model.

    Raises:
        CancelledError: stopped as asked.
    """
    config = TrainConfig().model_copy(update={**_COARSE_SETTINGS, "background": background, "seed": seed})
    gaussians, shading = _train(
        dataset=dataset,
        config=config,
        state=initial_train_state(dataset, config, threads=use_threads(threads)),
        threads=threads,
        should_stop=should_stop,
        on_step=lambda done, _tracer: progress(done),
    )
    tracer = make_tracer(config.trace, threads=threads)
    tracer.build(gaussians, shading.features(gaussians))
    return tracer, shading


def seconds_per_iteration(
    dataset: Dataset,
    config: TrainConfig,
    first: FlatGaussians,
    *,
    threads: int,
    should_stop: Callable[[], bool] = lambda: False,
) -> float:
    """Return the seconds of an iteration, from the first ones of a training that begins with ``first``.

    Raises:
        CancelledError: stopped as asked.
    """
    times: list[float] = []

    def note(_done: int, _tracer: Tracer) -> None:
        times.append(time.perf_counter())

    enough = WARM_UP_ITERATIONS + TIMED_ITERATIONS
    trial = config.model_copy(
        update={"iterations": 100 * enough, "densify_from_iter": 100 * enough, "probe_rays": 256}
    )
    state = initial_state(first.select(slice(None)), config.seed)
    with suppress(CancelledError):
        _train(
            dataset=dataset,
            config=trial,
            state=state,
            threads=threads,
            should_stop=lambda: len(times) >= enough or should_stop(),
            on_step=note,
        )
    if should_stop():
        raise CancelledError("Stopped before the training; the same command with --resume goes on.")
    return (times[-1] - times[WARM_UP_ITERATIONS - 1]) / (len(times) - WARM_UP_ITERATIONS)


def _train(
    dataset: Dataset,
    config: TrainConfig,
    state: TrainState,
    threads: int,
    should_stop: Callable[[], bool],
    on_step: Callable[[int, Tracer], None],
) -> tuple[FlatGaussians, ShadingModel]:
    """Train silently, with checkpoints in a folder that is removed."""
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(
            dataset,
            config,
            state,
            folder=Path(folder),
            fingerprint="",
            progress=lambda _event: None,
            threads=threads,
            should_stop=should_stop,
            on_step=on_step,
        )
        return trainer.run(), trainer.shading
