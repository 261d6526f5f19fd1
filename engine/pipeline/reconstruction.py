"""The reconstruction job as a list of steps."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from octasplat.engine.blocks.piece_settings import require_blocks_possible
from octasplat.engine.core.errors import CheckpointError, ConfigError
from octasplat.engine.core.events import EventListener, JsonLinesWriter, RunFinished, broadcast
from octasplat.engine.core.threads import use_threads
from octasplat.engine.core.writing import restore_folder
from octasplat.engine.dataset.views_file import ViewsRecord, read_views
from octasplat.engine.files import check_writable
from octasplat.engine.pipeline.block_request import BlockRequest, keep_request
from octasplat.engine.pipeline.block_steps import TrainBlock
from octasplat.engine.pipeline.dataset_steps import FindPoses, OpenBlockPhotographs, OpenDataset
from octasplat.engine.pipeline.material_choice import with_recorded_choice
from octasplat.engine.pipeline.output_folder import claim_output, release_on_refusal
from octasplat.engine.pipeline.result_steps import EvaluateStep, ExportStep
from octasplat.engine.pipeline.run import OnStep, ReconstructionRun, Step, run_steps
from octasplat.engine.pipeline.run_lock import lock_run_folder
from octasplat.engine.pipeline.start_scene import keep_found_models, keep_start
from octasplat.engine.pipeline.train_step import TrainStep, tell_of_former_scene
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.runs.run_folder import CACHE, EVENTS, METRICS, POSES, REPORT, SCENE, VIEWS

DATASET_STEPS = (FindPoses(), OpenDataset())
"""The steps that may refuse the photographs or the settings."""
RESULT_STEPS = (TrainStep(), EvaluateStep(), ExportStep())


def reconstruct(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    *,
    resume: bool = False,
    threads: int = 0,
    progress: EventListener = lambda _event: None,
    should_stop: Callable[[], bool] = lambda: False,
    on_step: OnStep | None = None,
    blocks: BlockRequest | None = None,
    start_from: Path | None = None,
    steps: Sequence[Step] = RESULT_STEPS,
    given: tuple[str, ...] | None = None,
) -> Path:
    """Reconstruct ``scene`` into the folder ``output`` and return it.

    The folder then holds ``scene.ply``, the meshes, ``metrics.json``, ``report.html``, ``renders/``,
    ``checkpoints/``, ``config.json``, ``held_out.json``, ``views.json`` and ``events.jsonl``.

    Args:
        scene: folder with photographs and a COLMAP model, see :meth:`octasplat.engine.dataset.Dataset.open`;
            one of photographs alone, if ``config`` says that poses are to be found, which then are in
            ``poses/``.
        output: a folder that does not exist, is empty, or holds the same run if ``resume``.
        config: all settings.
        resume: go on with the run that is in ``output``; only ``exports`` may then be others than the run's.
        threads: for everything; 0 means all cores.
        progress: receives the events that also go to ``events.jsonl``.
        should_stop: asked now and then; True stops the run after a checkpoint.
        on_step: shown the training after each iteration of a scene that is trained as a whole; it must
            change nothing.
        start_from: a run, finished or stopped, or a file of Gaussians to begin with instead of the sparse
            points; None, with ``resume``, goes on as the run was begun.
        blocks: how to train in blocks; None trains the scene as a whole or, with ``resume``, as it was begun.
        steps: what is done once the photographs are open, where that is only a part of the run.
        given: names of the settings that somebody asked for, see
            :func:`octasplat.engine.runs.config.given_settings`, which a run keeps that was to learn materials
            and does not; None where that is not known or, with ``resume``, takes those of the run.

    Raises:
        DatasetError: the photographs or the model cannot be used, or no poses be found.
        ColmapCrashError: COLMAP died.
        OutputError: ``output`` holds something else or cannot be written.
        ConfigError: settings that the photographs rule out or, with ``resume``, other ones than the run's.
        SceneFileError: a file of ``exports`` could not be written on this machine; told before the training.
        CheckpointError: with ``resume``, other photographs or another model than the run's.
        TrainingError: training collapsed.
        ExportError: some of ``exports`` could not be written; all the rest is there.
        CancelledError: stopped as asked.
    """
    if not (output / SCENE).exists():
        check_writable(config.exports)
    if blocks is not None and start_from is not None:
        raise ConfigError(
            "A scene that is trained in blocks begins anew; leave --blocks or --start-from out."
        )
    if blocks is not None and (blocks.count or 1) > 1:  # of an automatic number it is known later
        require_blocks_possible(config)
    use_threads(threads)
    config, found_by = config.without_run_of_model()
    if resume:
        config, given = with_recorded_choice(output, config, given)
    # before the claim, which makes the folder
    is_made, is_new = not output.exists(), claim_output(scene, output, config, resume, given=given)
    with lock_run_folder(output):
        restore_folder(output / POSES)  # before anything looks for poses, which might be found or copied anew
        with release_on_refusal(output, is_new=is_new, is_made=is_made):
            blocks = keep_request(output, blocks, is_new=is_new)
            keep_start(scene, output, start_from, is_new=is_new)
            keep_found_models(scene, output, found_by)
        _run_all_steps(
            ReconstructionRun(
                scene=scene,
                output=output,
                config=config,
                given=given,
                threads=threads,
                progress=progress,
                should_stop=should_stop,
                on_step=on_step,
                blocks=blocks,
            ),
            steps,
            is_new=is_new,
            is_made=is_made,
        )
    return output


def _run_all_steps(run: ReconstructionRun, steps: Sequence[Step], *, is_new: bool, is_made: bool) -> None:
    """Open the photographs of a run whose folder is claimed, and execute steps."""
    began, output = time.perf_counter(), run.output
    recorded = read_views(output / VIEWS) if (output / VIEWS).exists() else None
    # held back until the photographs are known to be the same
    events = JsonLinesWriter(output / EVENTS, hold=recorded is not None)
    report = broadcast([events, run.progress])
    run.progress, run.recorded = report, recorded
    if recorded is not None:
        run.check_views = _require_same_dataset(recorded, run.scene, output, events)
    try:
        with release_on_refusal(output, is_new=is_new, is_made=is_made):
            run_steps(_steps_before(steps), run)
        if not all((output / name).exists() for name in (METRICS, REPORT, *run.config.exports)):
            tell_of_former_scene(run)
        run_steps(steps, run)
        run.dataset.release_pages()
        if steps is RESULT_STEPS:
            report(RunFinished(_result_names(output), time.perf_counter() - began))
    finally:
        events.close()


def _steps_before(steps: Sequence[Step]) -> Sequence[Step]:
    """Return the steps that open the photographs which the others need."""
    blocks = [step for step in steps if isinstance(step, TrainBlock)]
    return (OpenBlockPhotographs(blocks[0].number),) if blocks else DATASET_STEPS


def _result_names(output: Path) -> tuple[str, ...]:
    """Return the names in the folder of a run, except its cache."""
    names = (path.name for path in output.iterdir())
    return tuple(sorted(name for name in names if name != CACHE and not name.startswith(".")))


def _require_same_dataset(
    recorded: ViewsRecord, scene: Path, output: Path, events: JsonLinesWriter
) -> Callable[[ViewsRecord], None]:
    """Return a check that a run resumes with its own photographs only; nothing is written before it."""

    def check_views(found: ViewsRecord) -> None:
        if (difference := recorded.difference(found)) is not None:
            raise CheckpointError(
                f"{output} was made from other photographs or another model than {scene} holds "
                f"({difference}); name the folder that it was made from, or another output folder."
            )
        events.release()

    return check_views
