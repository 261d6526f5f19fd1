"""Training of a scene in blocks: coarse scene and plan, a training for each block, and the end.

Each piece needs only the photographs, the settings, and the files of the pieces before it in the folder, so
that they may be trained by one process after the other or by several on different machines.
"""

from collections.abc import Callable, Sequence

from octasplat.engine.blocks.block_dataset import BlockDataset
from octasplat.engine.blocks.block_merge import (
    BlockScene,
    finish_scene,
    make_piece_tracer,
    polish_iterations,
    stop_when_asked,
)
from octasplat.engine.blocks.block_plan import Block, plan_blocks
from octasplat.engine.blocks.piece_progress import PieceProgress
from octasplat.engine.blocks.piece_settings import (
    block_iterations,
    block_margin,
    block_settings,
    coarse_settings,
    coarse_side_px,
    finish_iterations,
    fits_together,
)
from octasplat.engine.blocks.piece_training import BlockWork, Piece, is_piece_done, train_piece
from octasplat.engine.blocks.scene_plan import (
    COARSE,
    FINISH,
    POLISH,
    ScenePlan,
    block_name,
    has_plan,
    load_plan_to_train,
    save_plan,
)
from octasplat.engine.core.events import Noted
from octasplat.engine.core.threads import use_threads
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.train.config import TrainConfig, min_tile_side_px
from octasplat.engine.train.initialization.initial_gaussians import initial_train_state
from octasplat.engine.train.loop.checkpoint import BestState, load_best
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction, view_sizes_px


def train_in_blocks(
    work: BlockWork,
    count: int,
    open_coarse: Callable[[int], Dataset],
    *,
    most_gaussians: int | None = None,
) -> BlockScene:
    """Train a scene in blocks, one after the other; goes on where an earlier process stopped.

    Args:
        work: photographs, settings and the folder of the pieces.
        count: number of blocks, 2 at least.
        open_coarse: opens the same photographs with a given longest side, px.
        most_gaussians: of any block; None for no such limit.

    Raises:
        ConfigError: the scene cannot be cut into so many.
        CheckpointError: the plan that is there is damaged, or of a version with other results.
        TrainingError: a training collapsed.
        CancelledError: stopped as asked.
    """
    tell = PieceProgress(work.progress)
    plan = plan_scene(work, count, open_coarse, tell, most_gaussians=most_gaussians)
    tell.expect(plan.expected_iterations())
    for number in range(1, count + 1):
        train_block(work, plan, number, tell)
    return finish_scene(work, plan, tell)


def plan_scene(
    work: BlockWork,
    count: int,
    open_coarse: Callable[[int], Dataset],
    tell: PieceProgress,
    *,
    most_gaussians: int | None = None,
) -> ScenePlan:
    """Train the coarse scene and cut it into blocks, or return the plan that is there.

    Args:
        work: see :func:`train_in_blocks`.
        count: likewise.
        open_coarse: likewise.
        tell: tells the progress.
        most_gaussians: see :func:`train_in_blocks`.

    Raises:
        CheckpointError: the plan that is there is damaged, or of a version with other results.
    """
    if has_plan(work.folder):
        return load_plan_to_train(work.folder)
    tell.expect(_guess_iterations(work, count, most_gaussians))
    coarse = _train_coarse(work, tell, open_coarse).gaussians
    is_finished_together = _is_finished_together(work, most_gaussians)
    blocks = plan_blocks(
        work.dataset, coarse, count, make_piece_tracer(work), lambda: stop_when_asked(work),
        min_side_px=min_tile_side_px(work.config),
        margin=block_margin(is_finished_later=is_finished_together),
    )  # fmt: skip
    lengths = []
    for block in blocks:
        config = block_settings(
            work.config, block.share, most_gaussians, is_finished_later=is_finished_together
        )
        lengths.append(
            _block_iterations(work, block.pixels, config, is_finished_later=is_finished_together)
            if block.is_trained
            else 0
        )
    plan = ScenePlan(
        blocks,
        tuple(lengths),
        coarse_iterations=coarse_settings(work.config).iterations,
        last_iterations=finish_iterations(lengths)
        if is_finished_together
        else _guess_polish_iterations(work.config, blocks),
        most_gaussians=most_gaussians,
        is_finished_together=is_finished_together,
    )
    save_plan(plan, work.folder)
    return plan


def train_block(work: BlockWork, plan: ScenePlan, number: int, tell: PieceProgress) -> None:
    """Train a block, go on with its training, or do nothing where it is done.

    Args:
        work: photographs, settings and the folder with the plan and the coarse scene.
        plan: of the scene.
        number: of the block, from 1.
        tell: tells the progress.

    Raises:
        CheckpointError: the coarse scene is missing or damaged.
        TrainingError: the training collapsed.
        CancelledError: stopped as asked.
    """
    name, count, block = block_name(number), len(plan.blocks), plan.blocks[number - 1]
    if is_piece_done(work, name):
        return
    if not block.is_trained:
        work.progress(
            Noted(
                f"Block {number} of {count} keeps its coarse Gaussians, since only {block.view_count} "
                "photographs show it."
            )
        )
        return
    coarse = load_best(work.folder / COARSE)
    scene = coarse.gaussians
    is_trained = block.trained.contains(scene.means_world)
    config = block_settings(
        work.config, block.share, plan.most_gaussians, is_finished_later=plan.is_finished_together
    ).model_copy(update={"iterations": plan.iterations[number - 1]})

    def start() -> TrainState:
        pixels_text = f"{block.pixels.pixel_count / 1e6:.1f} million pixels of {block.view_count} photographs"
        work.progress(Noted(f"Block {number} of {count} is trained, on {pixels_text}."))
        state = initial_state(scene.select(is_trained), config.seed)
        state.shading = dict(coarse.shading)
        return state

    data = BlockDataset(work.dataset, block.pixels)
    work.dataset.read_ahead(data.train_indices)
    around = scene.select(~is_trained)
    train_piece(work, Piece(name, data, config, start, around), tell.of_piece(name))


def _guess_iterations(work: BlockWork, count: int, most_gaussians: int | None) -> dict[str, int]:
    """Return the iterations of all pieces of a scene that is not planned yet, of blocks that are alike."""
    is_finished_together = _is_finished_together(work, most_gaussians)
    share = min(1.0, (1 + 2 * block_margin(is_finished_later=is_finished_together)) / count)
    pixels = max(1, round(share * work.dataset.train_pixel_count))
    config = block_settings(work.config, share, most_gaussians, is_finished_later=False)
    lengths = [block_iterations(config, pixels, is_finished_later=is_finished_together)] * count
    last = (
        {FINISH: finish_iterations(lengths)}
        if is_finished_together
        else {POLISH: polish_iterations(work.config, pixels, 1.0)}
    )
    blocks = {block_name(number): length for number, length in enumerate(lengths, start=1)}
    return {COARSE: coarse_settings(work.config).iterations, **blocks, **last}


def _train_coarse(work: BlockWork, tell: PieceProgress, open_coarse: Callable[[int], Dataset]) -> BestState:
    """Return the coarse scene, trained on smaller photographs."""
    config = coarse_settings(work.config)
    side_px = coarse_side_px(int(view_sizes_px(work.dataset).max()))
    data = work.dataset if is_piece_done(work, COARSE) else open_coarse(side_px)

    def start() -> TrainState:
        work.progress(Noted("A coarse scene is trained first, on smaller photographs."))
        return initial_train_state(data, config, threads=use_threads(work.threads))

    return train_piece(work, Piece(COARSE, data, config, start), tell.of_piece(COARSE))


def _is_finished_together(work: BlockWork, most_gaussians: int | None) -> bool:
    """Return whether one training may hold the Gaussians of all blocks."""
    dataset = work.dataset
    valid = valid_pixel_fraction(dataset)
    return fits_together(work.config, dataset.train_pixel_count, most_gaussians, valid)


def _block_iterations(
    work: BlockWork, pixels: Rectangles, config: TrainConfig, *, is_finished_later: bool
) -> int:
    valid = valid_pixel_fraction(BlockDataset(work.dataset, pixels))
    return block_iterations(config, pixels.drawn_pixel_count, valid, is_finished_later=is_finished_later)


def _guess_polish_iterations(config: TrainConfig, blocks: Sequence[Block]) -> int:
    overlap = sum(block.pixels.drawn_pixel_count for block in blocks) // len(blocks)
    return polish_iterations(config, overlap, 1.0)
