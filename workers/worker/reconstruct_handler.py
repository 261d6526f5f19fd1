"""Programs of the jobs that reconstruct; only such a job's own process imports this."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from octasplat.engine.blocks.block_disk import block_disk_bytes
from octasplat.engine.blocks.block_map import draw_block_map
from octasplat.engine.blocks.block_photographs import read_block_photographs
from octasplat.engine.blocks.piece_settings import block_settings
from octasplat.engine.blocks.scene_plan import COARSE, ScenePlan, block_name, has_plan, load_plan
from octasplat.engine.core.compiling import report_compilation
from octasplat.engine.core.errors import CheckpointError, ConfigError, OctasplatError
from octasplat.engine.core.events import (
    Event,
    EventListener,
    PhaseFinished,
    PhaseProgress,
    Warned,
    broadcast,
    ignore_events,
)
from octasplat.engine.core.progress import stop_when_asked
from octasplat.engine.dataset import Dataset, load_dataset_model
from octasplat.engine.dataset.views_file import read_views
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.operations.block_options import block_request
from octasplat.engine.operations.photograph_sizes import photograph_sizes
from octasplat.engine.pipeline import (
    BlockRequest,
    PlanBlocks,
    TrainBlock,
    block_files,
    missing_blocks,
    planned_blocks,
)
from octasplat.engine.pipeline import reconstruct as reconstruct_scene
from octasplat.engine.pipeline.block_request import keep_request
from octasplat.engine.poses.found_models import read_pose_record
from octasplat.engine.poses.stored_search import search_folder
from octasplat.engine.render.image_files import write_png
from octasplat.engine.runs.run_folder import (
    BLOCKS,
    CACHE,
    CHECKPOINTS,
    CONFIG,
    POSES,
    SCENE,
    START,
    VIEWS,
    found_model_folder,
)
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.loop.checkpoint import load_best
from octasplat.workers.worker.job_kinds.reconstruct_kinds import (
    BlockJobConfig,
    ReconstructJobConfig,
    given_settings,
)
from octasplat.workers.worker.live_scene import LiveSceneWriter
from octasplat.workers.worker.preview import PREVIEW_FILE, PreviewRenderer, PreviewWritten
from octasplat.workers.worker.publishing import path_redactor, publish_file
from octasplat.workers.worker.task import BlocksPlanned, Task

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
        if (task.run / START).exists():  # what the job begins with is in what was there
            raise ConfigError(
                f"What was there cannot be gone on with; retry the job from the start: {message}"
            ) from None
        task.progress(Warned(f"What was there cannot be gone on with, so the job begins anew: {message}"))
        _discard_run(task.run)
        shutil.rmtree(task.results)
        _run_reconstruction(task)


def _discard_run(run: Path) -> None:
    """Remove what an earlier attempt left, but for poses that were found and the state of a search for them.

    Either takes hours, depends on no settings of the run, and says itself what photographs it is of.
    """
    kept = {search_folder(run / POSES)}
    record = read_pose_record(run / POSES)
    if "photographs_sha256" in record and "lenses" not in record:
        kept.add(run / POSES)
    for path in run.iterdir():
        if path.is_dir() and path not in kept:
            shutil.rmtree(path)
        elif path not in kept:
            path.unlink()


def train_block(task: Task) -> None:
    """Train a block of a run that another job has planned; what it comes to is the result."""
    options = BlockJobConfig.model_validate(task.options)
    own = task.run / BLOCKS / block_name(options.number)
    has_left = own.exists()
    try:
        _run_step(task, options, TrainBlock(options.number))
    except CheckpointError:
        if not has_left:
            raise
        shutil.rmtree(own)  # an earlier attempt left what cannot be gone on with
        _run_step(task, options, TrainBlock(options.number))
    for path in block_files(task.run, options.number):
        publish_file(task, path, path.relative_to(task.run).as_posix())
    _show_block(task, options)


def _plan_blocks(
    task: Task, options: ReconstructJobConfig, blocks: BlockRequest, show_points: EventListener
) -> bool:
    """Plan the blocks of a run, if it has several; return whether they are to be trained by other jobs."""
    if planned_blocks(task.run) is None:
        _run_step(task, options, PlanBlocks(), blocks, also=show_points)
    if (plan := planned_blocks(task.run)) is None or not missing_blocks(task.run, plan):
        return False
    _show_map(task, options, plan)
    _show_coarse_scene(task, options, plan)
    lengths = {number: length for number, length in enumerate(plan.iterations, start=1) if length}
    total = sum(plan.expected_iterations().values())
    disk_bytes = _disk_of_blocks(task, options, plan, tuple(lengths))
    task.progress(
        BlocksPlanned(tuple(lengths), tuple(lengths.values()), plan.coarse_iterations, total, disk_bytes)
    )
    return True


def _disk_of_blocks(
    task: Task, options: ReconstructJobConfig, plan: ScenePlan, numbers: Sequence[int]
) -> tuple[int, ...]:
    """Return how many bytes each block takes beside what it begins with; none of a plan of old."""
    known = read_block_photographs(task.run / BLOCKS)
    if known is None:
        return ()
    coarse = load_best(task.run / BLOCKS / COARSE)
    views = read_views(task.run / VIEWS).viewpoints(options.max_side)
    train, is_later = options.run_config().train, plan.is_finished_together
    found = []
    for number in numbers:
        share = plan.blocks[number - 1].share
        config = block_settings(train, share, plan.most_gaussians, is_finished_later=is_later)
        found.append(block_disk_bytes(plan, number, known, views, config, coarse))
    return tuple(found)


def _show_map(task: Task, options: ReconstructJobConfig, plan: ScenePlan) -> None:
    """Let a map of the blocks be the preview, unless the model cannot be read, of which the run tells."""
    assert task.scene is not None
    try:
        model = load_dataset_model(
            task.scene,
            model_folder=found_model_folder(task.run),
            model=options.model,
            for_training=False,
        )
    except OctasplatError:
        return
    drawn = draw_block_map(model, [block.core for block in plan.blocks])
    write_png(task.run / PREVIEW_FILE, drawn.image_srgb)
    positions = tuple((number, float(x), float(y)) for number, (x, y) in enumerate(drawn.middles, start=1))
    task.progress(PreviewWritten(PREVIEW_FILE, plan.coarse_iterations, None, positions))


def _show_coarse_scene(task: Task, options: ReconstructJobConfig, plan: ScenePlan) -> None:
    """Let the coarse scene be the live scene for as long as blocks are trained."""
    coarse = load_best(task.run / BLOCKS / COARSE).gaussians
    views = read_views(task.run / VIEWS).viewpoints(options.max_side)
    cores = [coarse.select(block.core.contains(coarse.means_world)) for block in plan.blocks]
    LiveSceneWriter(task.run, task.progress).write_blocks(plan.coarse_iterations, cores, views)


def _show_block(task: Task, options: BlockJobConfig) -> None:
    """Let what a block has learnt be its live scene, which is shown in the place of the coarse Gaussians.

    Its results are there by now, and count whatever becomes of this.
    """
    try:
        plan = load_plan(task.run / BLOCKS)
        found = load_best(task.run / BLOCKS / block_name(options.number)).gaussians
        core = found.select(plan.blocks[options.number - 1].core.contains(found.means_world))
        views = read_views(task.run / VIEWS).viewpoints(options.max_side)
        live = LiveSceneWriter(task.run, task.progress)
        live.write_block(options.iterations, core, len(plan.blocks), views)
    except (OctasplatError, OSError) as error:
        message = path_redactor(task).replace_job_paths(str(error))
        task.progress(Warned(f"What the block has learnt is not shown before the merge: {message}"))


def _run_step(
    task: Task,
    options: ReconstructJobConfig,
    step: PlanBlocks | TrainBlock,
    blocks: BlockRequest | None = None,
    also: EventListener = ignore_events,
) -> None:
    """Run one step of a run after its photographs are open."""
    assert task.scene is not None
    with report_compilation(task.progress):
        reconstruct_scene(
            task.scene,
            task.run,
            options.run_config(),
            resume=True,
            threads=task.threads,
            progress=stop_when_asked(broadcast([task.progress, also]), task.should_stop),
            should_stop=task.should_stop,
            blocks=blocks,
            steps=(step,),
            given=given_settings(task.requested),
        )


def _run_reconstruction(task: Task) -> None:
    assert task.scene is not None
    options = ReconstructJobConfig.model_validate(task.options)
    config = options.run_config()
    blocks = _request_of_run(task.run, task.scene, options)
    live = LiveSceneWriter(task.run, task.progress)

    def show_points(event: Event) -> None:
        # As soon as poses are found, and again where they are mended; never in the place of a later state.
        if isinstance(event, PhaseFinished) and event.stage in _STAGES_OF_POSES:
            assert task.scene is not None
            if not any((task.run / CHECKPOINTS).glob("*.npz")) and not has_plan(task.run / BLOCKS):
                live.write_points(task.scene, found_model_folder(task.run), config.model)

    if blocks is not None and blocks.count != 1 and _plan_blocks(task, options, blocks, show_points):
        return
    preview = PreviewRenderer(task.run, config.evaluation_background, task.progress)

    def show_step(
        iteration: int, dataset: Dataset, tracer: Tracer, shading: ShadingModel, gaussians: FlatGaussians
    ) -> None:
        preview(iteration, dataset, tracer, shading)
        live(iteration, dataset, gaussians)

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
                blocks=blocks,
                start_from=task.begins_with,
                given=given_settings(task.requested),
            )
    finally:
        _publish_run(task)


def _request_of_run(run: Path, scene: Path, options: ReconstructJobConfig) -> BlockRequest | None:
    """Return how a run is to be trained in blocks: one that goes on as it was begun.

    This version may reckon otherwise how many Gaussians a memory holds.

    Raises:
        ConfigError: the memory holds no block, or what the run was begun with cannot be read.
    """
    if (run / CONFIG).exists():
        return keep_request(run, None, is_new=False)
    sizes = photograph_sizes(scene) if options.memory is not None else []
    return block_request(options, options.run_config(), sizes)


def _publish_run(task: Task) -> None:
    """Publish what a run has finished as results; there are none before the scene."""
    if not (task.run / SCENE).exists():
        return
    for path in sorted(task.run.rglob("*")):
        name = path.relative_to(task.run)
        # Hidden files are previews and live scenes, which are stored on their own, or files being written.
        hidden = any(part.startswith(".") for part in name.parts)
        if path.is_file() and not hidden and name.parts[0] not in (BLOCKS, CHECKPOINTS, CACHE, START):
            publish_file(task, path, name.as_posix())
