"""Photographs whose given poses are in doubt, by a training so short that it costs a few seconds.

A few thousand coarse Gaussians show well enough what the photographs have in common for those that stand in
the wrong place to be found, see :mod:`octasplat.engine.train.views.outlier_views`. What is wrong with them
it does not say.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.threads import use_threads
from octasplat.engine.dataset import Dataset
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.train.config import Background, TrainConfig
from octasplat.engine.train.initialization.first_state import initial_scene
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.sampling.batches import evaluation_background
from octasplat.engine.train.views.outlier_views import MIN_VIEWS, find_outlier_views, measure_views

PROBE_ITERATIONS = 200
PROBE_SIGMAS = 3.0
"""Nearer to the others than what is called a misfit after a long training, as matches have the last word."""
MAX_SUSPECTS, MAX_SUSPECT_FRACTION = 20, 0.25
"""No more views are in doubt, nor a larger share of all; the worst are."""
_SETTINGS: dict[str, object] = {
    "iterations": PROBE_ITERATIONS,
    "max_gaussians": 10_000,
    "rays_per_batch": 8192,
    "sh_degree": 0,
    "exposure": False,
    "early_stopping_db": 0.0,
    "probe_rays": 256,
}


def find_misplaced_views(
    dataset: Dataset,
    *,
    background: Background,
    seed: int,
    threads: int,
    should_stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int], None] = lambda _done: None,
) -> Int64[np.ndarray, " d"]:
    """Views, held-out ones too, that fit the others so badly that their poses are in doubt; in order.

    Args:
        dataset: the photographs.
        background: of the training to come.
        seed: of the training to come.
        threads: of the training; 0 means all cores.
        should_stop: asked between iterations.
        progress: told the iterations done, of :data:`PROBE_ITERATIONS`.

    Raises:
        CancelledError: stopped as asked.
    """
    if len(dataset.train_indices) < MIN_VIEWS:
        return np.zeros(0, np.int64)
    behind: Background = "auto" if background == "learnt" else background
    trial = TrainConfig().model_copy(update={**_SETTINGS, "background": behind, "seed": seed})
    try:
        with tempfile.TemporaryDirectory() as folder:
            trainer = Trainer(
                dataset,
                trial,
                initial_scene(dataset, trial, threads=use_threads(threads)),
                folder=Path(folder),
                fingerprint="",
                progress=lambda _event: None,
                threads=threads,
                should_stop=should_stop,
                on_step=lambda done, _tracer: progress(done),
            )
            gaussians = trainer.run()
    except CancelledError:
        raise CancelledError(
            "Stopped before the training, while looking for photographs in the wrong place; the same command "
            "with --resume goes on."
        ) from None
    tracer = make_tracer(trial.trace, threads=threads)
    tracer.build(gaussians, trainer.shading.features(gaussians))
    fits = measure_views(
        dataset, np.arange(len(dataset.views)), evaluation_background(behind), tracer, trainer.shading
    )
    doubtful = find_outlier_views(fits, dataset.views, dataset.train_indices, PROBE_SIGMAS)
    most = min(MAX_SUSPECTS, int(MAX_SUSPECT_FRACTION * len(dataset.views)))
    return np.sort(doubtful[:most])
