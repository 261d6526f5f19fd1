"""Trainings that are thrown away: for a coarse scene, for the pace of a machine, for what materials gain."""

import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.threads import use_threads
from octasplat.engine.dataset import Dataset
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.material_settings import Recipe
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.config import Background, TrainConfig, preset, with_materials
from octasplat.engine.train.initialization.initial_gaussians import initial_train_state
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.loop.validation_probe import draw_probe, measure_probe
from octasplat.engine.train.sampling.batches import evaluation_background

COARSE_ITERATIONS = 200
WARM_UP_ITERATIONS, TIMED_ITERATIONS = 10, 50
"""Iterations before the clock starts, as kernels compile and caches fill, and those that it counts."""
MATERIAL_TRIAL_RAYS = 300 * 2048
"""Rays of each of the two trainings that say whether materials are of use."""
MATERIAL_PROBE_RAYS = 8192
MATERIAL_TRIAL_SETTINGS: dict[str, object] = {
    "iterations": 300,
    "rays_per_batch": 2048,
    "max_gaussians": 4000,
    "exposure": False,
    "early_stopping_db": 0.0,
    "probe_rays": 256,
}
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


def material_gain_db(
    dataset: Dataset,
    *,
    recipe: Recipe = "split_sum",
    background: Background,
    seed: int,
    threads: int,
    should_stop: Callable[[], bool] = lambda: False,
) -> float:
    """Return by how much two short trainings show held-out pixels better with materials than without, dB.

    A thing that reflects its surroundings is explained better by materials and light than by colors that
    depend on the direction; of anything else the light that is learnt is a guess, which costs accuracy.

    Args:
        dataset: the photographs; pixels of the training views stand in where none are held out.
        recipe: of the materials.
        background: what lies behind everything.
        seed: of everything random.
        threads: of the trainings; 0 means all cores.
        should_stop: asked between iterations.

    Raises:
        CancelledError: stopped as asked.
    """
    indices = dataset.test_indices if len(dataset.test_indices) else dataset.train_indices
    color = evaluation_background(background)
    probe = draw_probe(dataset, indices, MATERIAL_PROBE_RAYS, color, np.random.default_rng(seed))
    found = []
    # For all recipes those settings by which it was measured what a trial says. There are no rays for edges:
    # these show colors, and would say for materials what colors alone explain.
    lit = with_materials(preset("fast"), "near_field")
    lit = lit.model_copy(update={"materials": lit.materials.model_copy(update={"recipe": recipe})})
    for base in (preset("fast"), lit):
        config = base.model_copy(update={**MATERIAL_TRIAL_SETTINGS, "background": background, "seed": seed})
        gaussians, shading = _train(
            dataset=dataset,
            config=config,
            state=initial_train_state(dataset, config, threads=use_threads(threads)),
            threads=threads,
            should_stop=should_stop,
            on_step=lambda _done, _tracer: None,
        )
        tracer = make_tracer(config.trace, threads=threads)
        tracer.build(gaussians, shading.features(gaussians))
        found.append(measure_probe(probe, dataset, tracer, shading)[0])
    return found[1] - found[0]


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

    enough, materials = WARM_UP_ITERATIONS + TIMED_ITERATIONS, config.materials
    if materials.secondary_from < 1:  # nearly all iterations trace reflections, the first ones would not
        materials = materials.model_copy(update={"secondary_from": 0.0})
    # it is stopped long before its end, and nothing is added meanwhile
    trial = config.model_copy(
        update={
            "iterations": 100 * enough,
            "densify_from_iter": 100 * enough,
            "probe_rays": 256,
            "materials": materials,
        }
    )
    state = initial_state(first.select(slice(None)), config.seed)  # copied, as training changes them in place
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
    # mean pace after the warm-up
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
