"""The training loop: iterations, and between them rebuilds, probes, checkpoints and densification."""

from collections.abc import Callable
from pathlib import Path

from engine.errors import Cancelled, TrainingFailure
from engine.events import CheckpointWritten, Listener, TrainingProgress
from engine.gaussians.model import FlatGaussians
from engine.gaussians.order import morton_order
from engine.shading.protocol import ShadingModel
from engine.trace.make import make_tracer
from engine.trace.protocol import Tracer
from engine.train.batches import BatchSource, DrawnAhead, TrainingData
from engine.train.checkpoint import save_checkpoint
from engine.train.config import TrainConfig, most_gaussians
from engine.train.densify import make_densifier
from engine.train.densify.propagating import Propagating
from engine.train.iteration import Differentiated, Machinery, iterate
from engine.train.probes import Judge, decibels
from engine.train.schedule import Schedule, Stopwatch
from engine.train.shading import make_shading
from engine.train.state import TrainState


class Trainer:
    """Trains flat Gaussians on a dataset.

    Args:
        dataset: the photographs.
        config: all knobs.
        state: where to begin, fresh or from a checkpoint.
        folder: checkpoints go here.
        fingerprint: what the checkpoints belong to.
        listener: hears the progress.
        threads: for everything; 0 means all cores.
        should_stop: asked wherever a run may stop, see :class:`engine.train.schedule.Schedule`.
        tracer: anything that follows the protocol; None takes the one that the configuration names.
        shading: likewise.
        onlooker: shown the iterations done and the tracer as it is then, after each; it may trace without
            recording and must change nothing.

    Attributes:
        state: where the training stands.
        schedule: when what happens.
        shading: the shading model.

    Raises:
        ConfigError: the settings do not suit the photographs.
    """

    def __init__(
        self,
        dataset: TrainingData,
        config: TrainConfig,
        state: TrainState,
        *,
        folder: Path,
        fingerprint: str,
        listener: Listener,
        threads: int = 0,
        should_stop: Callable[[], bool] = lambda: False,
        tracer: Tracer | None = None,
        shading: ShadingModel | None = None,
        onlooker: Callable[[int, Tracer], None] | None = None,
    ) -> None:
        self.state = state
        self._onlooker = onlooker
        self._config = config
        self._folder = folder
        self._fingerprint = fingerprint
        self._tell = listener
        self._should_stop = should_stop
        self._extent = dataset.extent
        self._batches = BatchSource(dataset, config)
        pixels = self._batches.sampler.pixel_count
        self.schedule = Schedule.of(config, pixels)
        densifier = make_densifier(
            config.densify,
            iterations=self.schedule.iterations,
            max_gaussians=most_gaussians(config, pixels),
        )
        if config.materials.learn and config.materials.propagation:
            densifier = Propagating(densifier, config.materials, iterations=self.schedule.iterations)
        self.shading = shading or make_shading(config, len(dataset.views), dataset.extent)
        if state.densifier:
            densifier.restore(state.densifier)
        if state.shading:
            self.shading.restore(state.shading)
        if tracer is None:  # boxes leave room for what moves between rebuilds
            tracer = make_tracer(config.trace, threads=threads, box_padding=config.box_padding)
        self._machinery = Machinery(tracer, self.shading, densifier)
        self._judge = Judge(dataset, config, folder, listener)

    def run(self) -> FlatGaussians:
        """Train to the end and return the Gaussians to export: the last ones, or the best if those collapsed.

        Raises:
            TrainingFailure: parameters became not-a-number, or nothing is left to see.
            Cancelled: stopped as asked; a checkpoint is on disk.
        """
        with DrawnAhead(self._batches) as batches:
            return self._run(batches)

    def _run(self, batches: DrawnAhead) -> FlatGaussians:
        state, schedule, machinery = self.state, self.schedule, self._machinery
        watch, began_at = Stopwatch(state.seconds), state.iteration
        stale = True  # whether the hierarchy is of other Gaussians
        while True:
            if schedule.rebuilds(state.iteration, len(state.gaussians)):
                state.raise_degree(schedule.sh_degree(state.iteration))
                self._build()
                self._pause(watch, resumed=0 < state.iteration == began_at)
            elif stale:
                self._build()
            if schedule.ends(state.iteration):
                return self._judge.choose(state, machinery.tracer, machinery.shading)
            batch = batches.draw(state.rng)
            if not self._draws_or_stops(state.iteration + 1):
                batches.begin(state.rng)
            progress = schedule.progress(state.iteration)
            found = iterate(state, batch, machinery, self._config, progress=progress, extent=self._extent)
            stale = schedule.may_densify(state.iteration) and self._densify()
            if schedule.tells(state.iteration):
                self._report(found, watch, state.iteration - began_at)
            if self._onlooker is not None and not stale:
                with watch.held():
                    self._onlooker(state.iteration, machinery.tracer)

    def _draws_or_stops(self, done: int) -> bool:
        """Whether, that far, anything but a batch draws from the generator or keeps its state."""
        schedule = self.schedule
        densifies = schedule.may_densify(done) and self._machinery.densifier.due(done)
        return densifies or schedule.ends(done) or schedule.rebuilds(done, len(self.state.gaussians))

    def _build(self) -> None:
        gaussians, machinery = self.state.gaussians, self._machinery
        machinery.tracer.build(gaussians, machinery.shading.features(gaussians))
        progress = self.schedule.progress(self.state.iteration)
        machinery.shading.settle(gaussians, machinery.tracer, progress=progress)

    def _pause(self, watch: Stopwatch, *, resumed: bool) -> None:
        """Measure and keep the state where that is due, and stop if asked to.

        A state that has just been read from its checkpoint was measured by the run that wrote it, if an
        unstopped run measures it at all: so the best one is the same with and without a stop.
        """
        state, schedule = self.state, self.schedule
        stopping = self._should_stop() and not schedule.ends(state.iteration)
        measuring = schedule.measures(state.iteration)
        if (stopping or measuring) and not resumed:
            with watch.held() as seconds:
                state.seconds = seconds
                if measuring:
                    self._judge.inspect(state, self._machinery.tracer, self._machinery.shading)
                self._save()
        if stopping:
            raise Cancelled(
                f"Stopped after iteration {state.iteration} of {schedule.iterations}; "
                "the same command with --resume goes on."
            )

    def _save(self) -> None:
        state = self.state
        state.densifier = self._machinery.densifier.state()
        state.shading = self._machinery.shading.state()
        path = save_checkpoint(state, self._folder, self._fingerprint)
        self._tell(CheckpointWritten(state.iteration, str(path)))

    def _densify(self) -> bool:
        """Let the strategy change the set of Gaussians if it is time; whether it was."""
        state, densifier = self.state, self._machinery.densifier
        if not densifier.due(state.iteration):
            return False
        gaussians, adam = densifier.apply(state.gaussians, state.adam, state.rng, extent=self._extent)
        if len(gaussians) == 0:
            raise TrainingFailure(
                f"Densification removed every Gaussian at iteration {state.iteration}; "
                "nothing is exported. Lower the pruning thresholds (--set densify.prune_opacity=...)."
            )
        # Neighbours in space become neighbours in memory, which the tracer's caches like.
        order = morton_order(gaussians.means_world)
        state.gaussians, state.adam = gaussians.select(order), adam.select(order)
        return True

    def _report(self, found: Differentiated, watch: Stopwatch, iterations_here: int) -> None:
        state, total = self.state, self.schedule.iterations
        pace_s = watch.seconds_here / iterations_here
        self._tell(
            TrainingProgress(
                iteration=state.iteration,
                total_iterations=total,
                loss=found.loss.value,
                psnr=decibels(state.running_mse),
                gaussians=len(state.gaussians),
                rays_per_second=self._config.rays / pace_s,
                hits_per_ray=found.hits_per_ray,
                seconds=watch.seconds,
                seconds_left=pace_s * (total - state.iteration),
            )
        )
