"""Training of a scene in blocks: coarse scene, partition, a training for each block, merge and polish."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from octasplat.engine.blocks.block_dataset import BlockDataset
from octasplat.engine.blocks.block_plan import Block, plan_blocks
from octasplat.engine.blocks.piece_progress import PieceProgress
from octasplat.engine.blocks.piece_settings import (
    POLISH_FRACTION,
    block_settings,
    coarse_settings,
    coarse_side_px,
    finish_iterations,
    finish_settings,
    fits_together,
    polish_settings,
)
from octasplat.engine.blocks.piece_training import BlockWork, Piece, is_piece_done, piece_record, train_piece
from octasplat.engine.blocks.pixel_selection import select_pixels
from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import Noted
from octasplat.engine.core.threads import use_threads
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.gaussians.merge import with_sh_degree
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.config import TrainConfig, iteration_count, max_gaussian_count
from octasplat.engine.train.initialization.initial_gaussians import initial_train_state
from octasplat.engine.train.loop.checkpoint import BestState
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.sampling.batches import evaluation_background
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction, view_sizes_px
from octasplat.engine.train.shading_factory import ShadingOptions, make_shading
from octasplat.engine.train.views.view_grids import estimate_untrained_exposures

COARSE, POLISH, FINISH = "coarse", "polish", "finish"


@dataclass(frozen=True, eq=False)
class BlockScene:
    """A scene that was trained in blocks.

    Attributes:
        gaussians: of all blocks, those of one after those of the other.
        shading: exposures and background, those of the last piece that learnt them.
        record: what each training took, for ``training.json``.
    """

    gaussians: FlatGaussians
    shading: ShadingModel
    record: Mapping[str, Any]


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
        TrainingError: a training collapsed.
        CancelledError: stopped as asked.
    """
    tell = PieceProgress(work.progress)
    coarse = _train_coarse(work, count, tell, open_coarse)
    blocks = plan_blocks(
        work.dataset, coarse.gaussians, count, _tracer(work), lambda: _stop_when_asked(work),
        min_side_px=_min_side_px(work.config),
    )  # fmt: skip
    is_finished_together = _is_finished_together(work, blocks, most_gaussians)
    settings = [
        block_settings(work.config, block.share, most_gaussians, is_finished_later=is_finished_together)
        for block in blocks
    ]
    lengths = [
        _block_iterations(work, block.pixels, config) if block.is_trained else 0
        for block, config in zip(blocks, settings, strict=True)
    ]
    last = FINISH if is_finished_together else POLISH
    tell.expect(_expected_iterations(work, blocks, lengths, last))
    cores = [
        _train_block(work, number, block, config, coarse, tell, count)
        for number, (block, config) in enumerate(zip(blocks, settings, strict=True), start=1)
    ]
    is_near_cut = np.concatenate(
        [
            ~block.core.grown(-block.margin_world).contains(core.means_world)
            for block, core in zip(blocks, cores, strict=True)
        ]
    )
    merged = concatenate([with_sh_degree(core, work.config.sh_degree) for core in cores])
    del cores
    if is_finished_together:
        finished = _finish(work, merged, coarse, tell, finish_iterations(lengths))
    else:
        finished = BestState(_polish(work, merged, is_near_cut, coarse, tell), coarse.shading)
    merged, shading = finished.gaussians, _final_shading(work, finished)
    pieces = [COARSE, *(_block_name(number) for number in range(1, count + 1)), last]
    return BlockScene(merged, shading, {name: piece_record(work, name) for name in pieces})


def _train_coarse(
    work: BlockWork, count: int, tell: PieceProgress, open_coarse: Callable[[int], Dataset]
) -> BestState:
    """Return the coarse scene, trained on smaller photographs."""
    config = coarse_settings(work.config)
    each = iteration_count(work.config, work.dataset.train_pixel_count)
    names = {_block_name(number): each for number in range(1, count + 1)}
    tell.expect({COARSE: config.iterations, **names})
    side_px = coarse_side_px(int(view_sizes_px(work.dataset).max()))
    data = work.dataset if is_piece_done(work, COARSE) else open_coarse(side_px)

    def start() -> TrainState:
        work.progress(Noted("A coarse scene is trained first, on smaller photographs."))
        return initial_train_state(data, config, threads=use_threads(work.threads))

    return train_piece(work, Piece(COARSE, data, config, start), tell.of_piece(COARSE))


def _train_block(
    work: BlockWork, number: int, block: Block, config: TrainConfig, coarse: BestState,
    tell: PieceProgress, count: int,
) -> FlatGaussians:  # fmt: skip
    """Return the Gaussians of a block's core; those of the coarse scene where few views show it."""
    name, scene = _block_name(number), coarse.gaussians
    if not block.is_trained:
        work.progress(
            Noted(
                f"Block {number} of {count} keeps its coarse Gaussians, since only {block.view_count} "
                "photographs show it."
            )
        )
        return scene.select(block.core.contains(scene.means_world))
    is_trained = block.trained.contains(scene.means_world)

    def start() -> TrainState:
        pixels_text = f"{block.pixels.pixel_count / 1e6:.1f} million pixels of {block.view_count} photographs"
        work.progress(Noted(f"Block {number} of {count} is trained, on {pixels_text}."))
        state = initial_state(scene.select(is_trained), config.seed)
        state.shading = dict(coarse.shading)
        return state

    data = BlockDataset(work.dataset, block.pixels)
    around = scene.select(~is_trained)
    result = train_piece(work, Piece(name, data, config, start, around), tell.of_piece(name))
    return result.gaussians.select(block.core.contains(result.gaussians.means_world))


def _is_finished_together(work: BlockWork, blocks: Sequence[Block], most_gaussians: int | None) -> bool:
    """Return whether one training may hold the Gaussians of all blocks."""
    counts = []
    for block in blocks:
        config = block_settings(work.config, block.share, most_gaussians, is_finished_later=False)
        valid = valid_pixel_fraction(BlockDataset(work.dataset, block.pixels)) if block.is_trained else 1.0
        counts.append(max_gaussian_count(config, block.pixels.drawn_pixel_count, valid))
    return fits_together(work.config, counts, [block.share for block in blocks], most_gaussians)


def _finish(
    work: BlockWork, merged: FlatGaussians, coarse: BestState, tell: PieceProgress, iterations: int
) -> BestState:
    """Return the scene of which all Gaussians, exposures and the background went on together to the end."""

    def start() -> TrainState:
        work.progress(Noted(f"All blocks are finished together, {len(merged)} Gaussians."))
        state = initial_state(merged, work.config.seed)
        state.shading = dict(coarse.shading)
        return state

    piece = Piece(FINISH, work.dataset, finish_settings(work.config, iterations), start)
    return train_piece(work, piece, tell.of_piece(FINISH))


def _polish(
    work: BlockWork,
    merged: FlatGaussians,
    is_near_cut: Bool[np.ndarray, " n"],
    coarse: BestState,
    tell: PieceProgress,
) -> FlatGaussians:
    """Return the scene with the Gaussians near to cuts trained once more, all of them together."""
    if not is_near_cut.any():
        return merged
    (pixels,) = select_pixels(
        work.dataset, merged, [is_near_cut], _tracer(work), lambda: _stop_when_asked(work),
        min_side_px=_min_side_px(work.config),
    )  # fmt: skip
    if len(pixels) == 0:
        return merged
    data = BlockDataset(work.dataset, pixels)
    iterations = _polish_iterations(work.config, pixels.drawn_pixel_count, valid_pixel_fraction(data))
    config = polish_settings(work.config, iterations)

    def start() -> TrainState:
        work.progress(Noted(f"The {int(is_near_cut.sum())} Gaussians near to cuts are trained together."))
        state = initial_state(merged.select(is_near_cut), config.seed)
        state.shading = dict(coarse.shading)
        return state

    piece = Piece(POLISH, data, config, start, merged.select(~is_near_cut), keeps_near_free=False)
    polished = train_piece(work, piece, tell.of_piece(POLISH))
    merged.put(is_near_cut, polished.gaussians)
    return merged


def _final_shading(work: BlockWork, scene: BestState) -> ShadingModel:
    """Return the shading of a scene, with exposures of held-out views as the scene suggests them."""
    options = ShadingOptions.from_config(work.config)
    shading = make_shading(options, len(work.dataset.views), work.dataset.extent)
    if scene.shading:
        shading.restore(dict(scene.shading))
    tracer = _tracer(work)
    tracer.build(scene.gaussians, shading.features(scene.gaussians))
    background = evaluation_background(work.config.background)
    estimate_untrained_exposures(work.dataset, background, tracer, shading)
    return shading


def _expected_iterations(
    work: BlockWork, blocks: Sequence[Block], lengths: Sequence[int], last: str
) -> dict[str, int]:
    """Return the iterations of all pieces; those of the polish are a guess."""
    counts = {COARSE: coarse_settings(work.config).iterations}
    counts |= {_block_name(number): length for number, length in enumerate(lengths, start=1)}
    if last == FINISH:
        return {**counts, FINISH: finish_iterations(lengths)}
    overlap = sum(block.pixels.drawn_pixel_count for block in blocks) // len(blocks)
    return {**counts, POLISH: _polish_iterations(work.config, overlap, 1.0)}


def _block_iterations(work: BlockWork, pixels: Rectangles, config: TrainConfig) -> int:
    data = BlockDataset(work.dataset, pixels)
    return iteration_count(config, pixels.drawn_pixel_count, valid_pixel_fraction(data))


def _polish_iterations(config: TrainConfig, pixels: int, valid_fraction: float) -> int:
    return max(1, round(POLISH_FRACTION * iteration_count(config, pixels, valid_fraction)))


def _min_side_px(config: TrainConfig) -> int:
    """Return the least side of a tile: patches for SSIM fit into it."""
    return config.ssim_patch_side if config.loss.ssim > 0 else 1


def _tracer(work: BlockWork) -> Tracer:
    return make_tracer(work.config.trace, threads=work.threads)


def _stop_when_asked(work: BlockWork) -> None:
    if work.should_stop():
        raise CancelledError("Stopped between two trainings; the same command with --resume goes on.")


def _block_name(number: int) -> str:
    return f"block_{number:03d}"
