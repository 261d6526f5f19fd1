"""Program of the jobs that reconstruct; only such a job's own process imports this."""

import shutil

from octasplat.engine.core.compiling import report_compilation
from octasplat.engine.core.errors import CheckpointError, ConfigError
from octasplat.engine.core.events import Event, PhaseFinished, PhaseProgress, Warned, broadcast
from octasplat.engine.core.progress import stop_when_asked
from octasplat.engine.dataset import Dataset
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pipeline import reconstruct as reconstruct_scene
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.run_folder import CACHE, CHECKPOINTS, CONFIG, SCENE, found_model_folder
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer
from octasplat.workers.worker.live_scene import LiveSceneWriter
from octasplat.workers.worker.preview import PreviewRenderer
from octasplat.workers.worker.publishing import path_redactor, publish_file
from octasplat.workers.worker.task import Task

_STAGES_OF_POSES = ("poses", "placing", "lenses", "load")


def reconstruct(task: Task) -> None:
    """Run a reconstruction, resumed from what an earlier attempt left.

    If that is of other settings, as another version may understand the same options, it begins anew.
    """
    # Read before the run begins, which writes this file itself.
    has_left = (task.run / CONFIG).exists()
    try:
        _run_reconstruction(task)
    except (CheckpointError, ConfigError) as error:
        if not has_left:
            raise
        message = path_redactor(task).replace_job_paths(str(error))
        task.progress(Warned(f"What was there cannot be gone on with, so the job begins anew: {message}"))
        shutil.rmtree(task.run)
        shutil.rmtree(task.results)
        _run_reconstruction(task)


def _run_reconstruction(task: Task) -> None:
    assert task.scene is not None
    config = ReconstructionConfig.model_validate(task.options)

    preview = PreviewRenderer(task.run, config.evaluation_background, task.progress)
    live = LiveSceneWriter(task.run, task.progress)

    def show_step(
        iteration: int, dataset: Dataset, tracer: Tracer, shading: ShadingModel, gaussians: FlatGaussians
    ) -> None:
        preview(iteration, dataset, tracer, shading)
        live(iteration, dataset, gaussians)

    def show_points(event: Event) -> None:
        # As soon as poses are found, and again where they are mended; never in the place of a later state.
        if isinstance(event, PhaseFinished) and event.stage in _STAGES_OF_POSES:
            assert task.scene is not None
            if not any((task.run / CHECKPOINTS).glob("*.npz")):
                live.write_points(task.scene, found_model_folder(task.run), config.model)

    def publish_finished(event: Event) -> None:
        # Whatever becomes of the rest, even if this process is killed.
        if isinstance(event, PhaseFinished) or (isinstance(event, PhaseProgress) and event.stage == "export"):
            _publish_run(task)

    try:
        with report_compilation(task.progress):
            reconstruct_scene(
                task.scene,
                task.run,
                config,
                resume=True,
                threads=task.threads,
                progress=stop_when_asked(
                    broadcast([task.progress, publish_finished, show_points]), task.should_stop
                ),
                should_stop=task.should_stop,
                on_step=show_step,
            )
    finally:
        _publish_run(task)


def _publish_run(task: Task) -> None:
    """Publish what a run has finished as results; there are none before the scene."""
    if not (task.run / SCENE).exists():
        return
    for path in sorted(task.run.rglob("*")):
        name = path.relative_to(task.run)
        # Hidden files are previews and live scenes, which are stored on their own, or files being written.
        hidden = any(part.startswith(".") for part in name.parts)
        if path.is_file() and not hidden and name.parts[0] not in (CHECKPOINTS, CACHE):
            publish_file(task, path, name.as_posix())
