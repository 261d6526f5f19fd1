"""Merge of the blocks of a scene, and the training that follows: of all together, or of what is near cuts."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from octasplat.engine.blocks.block_dataset import BlockDataset
from octasplat.engine.blocks.core_merge import merge_cores
from octasplat.engine.blocks.piece_progress import PieceProgress
from octasplat.engine.blocks.piece_settings import (
    POLISH_FRACTION,
    finish_settings,
    polish_settings,
)
from octasplat.engine.blocks.piece_training import BlockWork, Piece, piece_record, train_piece
from octasplat.engine.blocks.pixel_selection import select_pixels
from octasplat.engine.blocks.scene_plan import COARSE, FINISH, POLISH, ScenePlan
from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import Noted
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import select_into_files
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.config import TrainConfig, iteration_count, min_tile_side_px
from octasplat.engine.train.loop.checkpoint import BestState, load_best
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.sampling.batches import evaluation_background
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction
from octasplat.engine.train.shading_factory import ShadingOptions, make_shading
from octasplat.engine.train.views.view_grids import estimate_untrained_exposures


@dataclass(frozen=True, eq=False)
class BlockScene:
    """A scene that was trained in blocks.

    Attributes:
        gaussians: of all blocks, those of one after those of the other; they may be in files without a name.
        shading: exposures and background, those of the last piece that learnt them.
        record: what each training took, for ``training.json``.
    """

    gaussians: FlatGaussians
    shading: ShadingModel
    record: Mapping[str, Any]


def finish_scene(work: BlockWork, plan: ScenePlan, tell: PieceProgress) -> BlockScene:
    """Merge the blocks and train the last piece; goes on where an earlier process stopped.

    Args:
        work: photographs, settings and the folder with the plan, the coarse scene and all blocks.
        plan: of the scene.
        tell: tells the progress.

    Raises:
        CheckpointError: a block is missing or damaged.
        TrainingError: the training collapsed.
        CancelledError: stopped as asked.
    """
    coarse = load_best(work.folder / COARSE)
    merged, is_near_cut = merge_cores(work.folder, work.config, plan, coarse)
    if plan.is_finished_together:
        finished = _finish(work, plan, merged, coarse, tell)
    else:
        finished = BestState(_polish(work, plan, merged, is_near_cut, coarse, tell), coarse.shading)
    pieces = [COARSE, *plan.block_names, plan.last_piece]
    shading = _final_shading(work, finished)
    return BlockScene(finished.gaussians, shading, {name: piece_record(work, name) for name in pieces})


def _finish(
    work: BlockWork, plan: ScenePlan, merged: FlatGaussians, coarse: BestState, tell: PieceProgress
) -> BestState:
    """Return the scene of which all Gaussians, exposures and the background went on together to the end."""

    def start() -> TrainState:
        work.progress(Noted(f"All blocks are finished together, {len(merged)} Gaussians."))
        state = initial_state(merged.copy(), work.config.seed)  # from files to memory
        state.shading = dict(coarse.shading)
        return state

    config = finish_settings(work.config, plan.last_iterations, plan.iterations)
    piece = Piece(FINISH, work.dataset, config, start)
    return train_piece(work, piece, tell.of_piece(FINISH))


def _polish(
    work: BlockWork,
    plan: ScenePlan,
    merged: FlatGaussians,
    is_near_cut: Bool[np.ndarray, " n"],
    coarse: BestState,
    tell: PieceProgress,
) -> FlatGaussians:
    """Return the scene with the Gaussians near to cuts trained once more, all of them together."""
    if not is_near_cut.any():
        return merged
    (pixels,) = select_pixels(
        work.dataset, merged, [is_near_cut], make_piece_tracer(work), lambda: stop_when_asked(work),
        min_side_px=min_tile_side_px(work.config),
    )  # fmt: skip
    if len(pixels) == 0:
        return merged
    data = BlockDataset(work.dataset, pixels)
    iterations = polish_iterations(work.config, pixels.drawn_pixel_count, valid_pixel_fraction(data))
    config = polish_settings(work.config, iterations, plan.iterations)

    def start() -> TrainState:
        work.progress(Noted(f"The {int(is_near_cut.sum())} Gaussians near to cuts are trained together."))
        state = initial_state(merged.select(is_near_cut), config.seed)
        state.shading = dict(coarse.shading)
        return state

    fixed = select_into_files(merged, ~is_near_cut, work.folder)
    piece = Piece(POLISH, data, config, start, fixed, is_fixed_in_files=True, keeps_near_free=False)
    progress = tell.of_piece(POLISH, other_gaussians=len(fixed))
    polished = train_piece(work, piece, progress)
    merged.put(is_near_cut, polished.gaussians)
    return merged


def _final_shading(work: BlockWork, scene: BestState) -> ShadingModel:
    """Return the shading of a scene, with exposures of held-out views as the scene suggests them."""
    options = ShadingOptions.from_config(work.config)
    shading = make_shading(options, len(work.dataset.views), work.dataset.extent)
    if scene.shading:
        shading.restore(dict(scene.shading))
    tracer = make_piece_tracer(work)
    tracer.build(scene.gaussians, shading.features(scene.gaussians))
    background = evaluation_background(work.config.background)
    estimate_untrained_exposures(work.dataset, background, tracer, shading)
    return shading


def polish_iterations(config: TrainConfig, pixels: int, valid_fraction: float) -> int:
    """Return the iterations of the polish of so many pixels, of which a share shows anything."""
    return max(1, round(POLISH_FRACTION * iteration_count(config, pixels, valid_fraction)))


def make_piece_tracer(work: BlockWork) -> Tracer:
    """Return a tracer for what is counted between two trainings."""
    return make_tracer(work.config.trace, threads=work.threads)


def stop_when_asked(work: BlockWork) -> None:
    """Stop between two trainings if that is asked for.

    Raises:
        CancelledError: it is.
    """
    if work.should_stop():
        raise CancelledError("Stopped between two trainings; the same command with --resume goes on.")
