"""Where the time of a training iteration goes, stage by stage, and how much of it runs on one thread only.

    python -m benchmarks.iteration SCENE --state state.npz [--max-side 480] [--threads 1 2] [--rounds 4]

Training goes on from the checkpoint ``state.npz``, which is made first where there is none; every round
begins there anew, so that all see the same rays and Gaussians. CPU ms are those of all threads, which other
programs on the machine hardly change; wall ms they do. Serial is what the calling thread works beyond the
others' mean share: what would remain on any number of threads. The batch is a stage of its own here; in a
training it is drawn beside the iteration before.
"""

import argparse
import copy
import os
import shutil
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # else CPU time counts threads that wait

import numpy as np

from octasplat.engine.core.threads import use_threads
from octasplat.engine.dataset import Dataset
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.config import TrainConfig, uses_shared_sort
from octasplat.engine.train.densify import make_densifier
from octasplat.engine.train.initialization.initial_gaussians import (
    InitialGaussianOptions,
    initial_gaussians,
)
from octasplat.engine.train.loop.checkpoint import load_checkpoint, save_checkpoint
from octasplat.engine.train.loop.iteration import TrainComponents, train_step
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.optimization.adam import Adam
from octasplat.engine.train.sampling.batches import BatchOptions, BatchSource
from octasplat.engine.train.shading_factory import ShadingOptions, make_shading

STAGES = ("batch", "trace", "backward", "Adam", "refresh", "rebuild", "loss and the rest")


class Clock:
    """Wall time, CPU time of all threads and that of this one, by stage."""

    def __init__(self) -> None:
        self.spent: dict[str, list[tuple[float, float, float]]] = defaultdict(list)

    def timed(self, stage: str, function: Callable) -> Callable:
        """``function`` with its time counted for ``stage``."""

        def run(*args, **options):
            before = _now()
            try:
                return function(*args, **options)
            finally:
                self.spent[stage].append(tuple(b - a for a, b in zip(before, _now(), strict=True)))

        return run


def _now() -> tuple[float, float, float]:
    return time.perf_counter(), time.process_time(), time.thread_time()


class TimedTracer:
    """A tracer whose every step is timed."""

    def __init__(self, tracer: Tracer, clock: Clock) -> None:
        self.settings = tracer.settings
        self.build = clock.timed("rebuild", tracer.build)
        self.refresh = clock.timed("refresh", tracer.refresh)
        self.trace = clock.timed("trace", tracer.trace)
        self.backward = clock.timed("backward", tracer.backward)
        self.transmittance = tracer.transmittance


def made(dataset: Dataset, config: TrainConfig, path: Path, iterations: int) -> None:
    """A checkpoint of a training after so many iterations."""
    state = initial_state(
        initial_gaussians(dataset, InitialGaussianOptions.from_config(config, dataset), threads=2),
        config.seed,
    )
    with tempfile.TemporaryDirectory() as folder:
        Trainer(
            dataset, config.model_copy(update={"iterations": iterations}), state,
            folder=Path(folder), fingerprint="iteration", progress=lambda _event: None,
        ).run()  # fmt: skip
        shutil.move(save_checkpoint(state, Path(folder), "iteration"), path)


def spent(
    dataset: Dataset, config: TrainConfig, state: TrainState, threads: int, iterations: int
) -> tuple[np.ndarray, float, float]:
    """Medians by stage of wall, CPU and own CPU time, seconds; hits a ray; Gaussians hit."""
    use_threads(threads)
    clock = Clock()
    settings = config.trace.model_copy(update={"sort": "packet" if uses_shared_sort(config) else "ray"})
    tracer = TimedTracer(make_tracer(settings, threads=threads, box_padding=config.box_padding), clock)
    densifier = make_densifier(config.densify, iterations=iterations, max_gaussians=len(state.gaussians))
    shading = make_shading(ShadingOptions.from_config(config), len(dataset.views), dataset.extent)
    machinery = TrainComponents(tracer, shading, densifier)
    batches = BatchSource(dataset, BatchOptions.from_config(config, dataset))
    draw = clock.timed("batch", batches.draw)
    step = clock.timed("iterate", train_step)
    hits, met = [], []
    adam_step = Adam.step
    Adam.step = clock.timed("Adam", adam_step)  # type: ignore[method-assign]
    try:
        for k in range(iterations):
            if k % config.rebuild_every == 0:
                tracer.build(state.gaussians)
            batch = draw(state.rng)
            found = step(
                state, batch, machinery,
                loss=config.loss, lr=config.lr, min_blend_weight=config.min_blend_weight,
                training_progress=0.5, extent=dataset.extent,
            )  # fmt: skip
            hits.append(found.hits_per_ray)
            met.append(len(found.gaussians.ids))
    finally:
        Adam.step = adam_step  # type: ignore[method-assign]
    stages = {name: np.median(np.array(rows[1:] or rows), axis=0) for name, rows in clock.spent.items()}
    stages["rebuild"] = stages["rebuild"] / config.rebuild_every
    inside = sum(stages[name] for name in ("trace", "backward", "Adam", "refresh"))
    stages["loss and the rest"] = stages.pop("iterate") - inside
    return np.array([stages[name] for name in STAGES]), float(np.mean(hits)), float(np.mean(met))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--state", type=Path, required=True)
    parser.add_argument("--preset", default="fast")
    parser.add_argument("--max-side", type=int, default=480)
    parser.add_argument("--warm", type=int, default=500, help="iterations before the checkpoint")
    parser.add_argument("--iterations", type=int, default=26, help="of a round")
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", dest="assignments")
    options = parser.parse_args()
    config = resolve_config(
        options.preset, settings={"max_side": options.max_side}, assignments=options.assignments
    ).train
    with tempfile.TemporaryDirectory() as cache:
        dataset = Dataset.open(options.scene, Path(cache), max_side=options.max_side, near=config.near)
        if not options.state.exists():
            made(dataset, config, options.state, options.warm)
        first = load_checkpoint(options.state, "iteration")
        rounds = defaultdict(list)
        for _ in range(options.rounds):
            for threads in options.threads:
                found, hits, met = spent(dataset, config, copy.deepcopy(first), threads, options.iterations)
                rounds[threads].append(found)
    print(
        f"{options.scene.name}: {len(first.gaussians)} Gaussians of degree {first.gaussians.sh_degree}, "
        f"{config.rays_per_batch} rays, {hits:.1f} hits a ray, {met:.0f} Gaussians met"
    )
    for threads, found_rounds in rounds.items():
        table = 1e3 * np.median(found_rounds, axis=0)
        total = table.sum(axis=0)
        print(f"\n{threads} threads | wall ms | CPU ms | serial ms")
        serial = np.zeros(len(STAGES))
        if threads > 1:
            others = (table[:, 1] - table[:, 2]) / (threads - 1)
            serial = np.maximum(table[:, 2] - others, 0.0)
        else:
            serial = np.full(len(STAGES), np.nan)
        for name, row, alone in zip(STAGES, table, serial, strict=True):
            print(f"{name:18s} | {row[0]:7.2f} | {row[1]:6.2f} | {alone:6.2f}")
        share = ""
        if threads > 1:  # in a training the batch is drawn beside the iteration before
            share = f", serial but for the batch {100 * serial[1:].sum() / total[1]:.1f} % of the CPU time"
        print(f"{'all':18s} | {total[0]:7.2f} | {total[1]:6.2f} | {serial.sum():6.2f}{share}")


if __name__ == "__main__":
    main()
