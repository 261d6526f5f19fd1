"""``plan``: the blocks of a large capture, and what they take, before anything starts."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from octasplat.engine.core.durations import format_duration
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.core.threads import available_threads
from octasplat.engine.operations.base import Operation, Result, WritingRequest, never_stop
from octasplat.engine.operations.block_options import BlockOptions, block_request
from octasplat.engine.operations.estimate import EstimateOptions
from octasplat.engine.operations.photograph_sizes import photograph_sizes
from octasplat.engine.settings.fields import Positional, ReadPath, Spelling

if TYPE_CHECKING:
    from octasplat.engine.blocks.sparse_plan import SparseBlock
    from octasplat.engine.dataset.model import DatasetModel
    from octasplat.engine.runs.config import ReconstructionConfig


class PlanOptions(EstimateOptions, BlockOptions):
    """Options of the reconstruction to plan, and the number of cores."""


class PlanRequest(PlanOptions, WritingRequest):
    """Plan the blocks of PHOTOS: how many, how many photographs show each, and the time and memory it takes.

    The options are those of reconstruct; without --blocks it is --blocks auto. The plan comes from the sparse
    points of the model in seconds; the run itself cuts by its coarse scene, so that its blocks are alike, not
    the same. Figures are right within a factor of two.
    """

    source: Annotated[Path, Positional("PHOTOS"), ReadPath()] = Field(
        description="The folder of the photographs and their model."
    )
    picture: Annotated[Path | None, Spelling(metavar="FILE.png")] = Field(
        None,
        description="Write a map of the points from above, a color a block, and of the cameras, in black.",
    )


class PlannedBlock(BaseModel):
    """A block of a plan.

    Attributes:
        photographs: that show some of it.
        pixels: of them that train it.
        seconds: by the clock.
        memory_bytes: of its training.
    """

    model_config = ConfigDict(frozen=True)

    photographs: int
    pixels: int
    seconds: float
    memory_bytes: int


class PlanResult(Result):
    """A plan, right within a factor of two.

    Attributes:
        blocks: the blocks; a single one is an ordinary run.
        photographs: that are trained on.
        cores: number of cores that is reckoned with.
        coarse_seconds: for the coarse scene, and for finishing or polishing the merged one.
        seconds: of the whole run by the clock, with nothing else to do.
        memory_bytes: largest memory of any training.
    """

    blocks: tuple[PlannedBlock, ...]
    photographs: int
    cores: int
    coarse_seconds: float
    seconds: float
    memory_bytes: int

    def lines(self) -> tuple[str, ...]:
        """Return the plan in sentences."""
        count = len(self.blocks)
        cores = f"{self.cores} core{'s' if self.cores > 1 else ''}"
        memory = f"{self.memory_bytes / 1e9:.1f} GB of memory"
        total = f"about {format_duration(self.seconds)} on {cores} and {memory}; within a factor of two."
        if count == 1:
            first = f"One block, an ordinary run, of {self.photographs} photographs: {total}"
            return (first, *super().lines())
        blocks = [
            f"  block {number}: {block.photographs} photographs, {block.pixels / 1e6:.1f} million pixels, "
            f"about {format_duration(block.seconds)}"
            for number, block in enumerate(self.blocks, start=1)
        ]
        rest = f"  coarse scene and end of the training: about {format_duration(self.coarse_seconds)}"
        first = f"{count} blocks of {self.photographs} photographs: {total}"
        return (first, *blocks, rest, *super().lines())


def run(
    request: PlanRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> PlanResult:
    """Plan a reconstruction in blocks; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        DatasetError: there are no photographs, or their model cannot be read.
        ConfigError: a setting cannot be used, there is no model, or no blocks can be made.
        OutputError: the picture cannot be written.
    """
    from octasplat.engine.blocks.block_map import draw_block_map
    from octasplat.engine.blocks.piece_settings import block_margin, fewest_blocks, fits_together
    from octasplat.engine.blocks.sparse_plan import plan_from_points
    from octasplat.engine.dataset import load_dataset_model
    from octasplat.engine.dataset.model_sources import has_model
    from octasplat.engine.dataset.scene_split import SplitRule, split_scene
    from octasplat.engine.operations.written_files import check_targets
    from octasplat.engine.pipeline import BlockRequest
    from octasplat.engine.poses.photographs import locate_scene
    from octasplat.engine.render.image_files import write_png

    if request.picture is not None:
        check_targets("plan", [request.picture], [request.source], overwrite=request.overwrite)
    scene, config = locate_scene(request.source), request.config()
    if not has_model(scene):
        raise ConfigError(
            f"{scene} has no COLMAP model, by whose points blocks are planned; reconstruct finds the poses "
            "and cuts by its coarse scene."
        )
    sizes = photograph_sizes(scene)
    asked = block_request(request, config, sizes) or BlockRequest()
    model = load_dataset_model(scene, max_side=config.max_side, model=config.model)
    rule = SplitRule(config.test_every, config.held_out, config.burst_length, config.split)
    trained = split_scene(model, rule).train_indices
    pixels = sum(model.views[index].width_px * model.views[index].height_px for index in trained.tolist())
    count = asked.count or fewest_blocks(config.train, len(trained), pixels, asked.most_gaussians)
    is_finished_later = fits_together(config.train, pixels, asked.most_gaussians)
    margin = block_margin(is_finished_later=is_finished_later)
    blocks = plan_from_points(model, trained, count, margin)
    cores = request.cores or threads or available_threads()
    costs = _costs(model, blocks, config, asked.most_gaussians, cores)  # which may refuse the settings
    files: tuple[Path, ...] = ()
    if request.picture is not None:
        write_png(request.picture, draw_block_map(model, [block.core for block in blocks]).image_srgb)
        files = (request.picture,)
    return PlanResult(files=files, photographs=len(trained), cores=cores, **costs)


def _costs(
    model: "DatasetModel",
    blocks: "tuple[SparseBlock, ...]",
    config: "ReconstructionConfig",
    most_gaussians: int | None,
    cores: int,
) -> dict[str, object]:
    """Return the figures of a plan by their names."""
    from octasplat.engine.blocks.piece_settings import require_blocks_possible
    from octasplat.engine.dataset.image_sizes import ImageSizes
    from octasplat.engine.operations.block_cost import BlockShare, estimate_blocks
    from octasplat.engine.operations.cost_model import estimate_reconstruction

    given = config.with_poses_decided(True)
    original = [ImageSizes(info.width_px, info.height_px, 1) for info in model.image_infos]
    if len(blocks) == 1:
        whole = estimate_reconstruction(given, original, cores)
        only = PlannedBlock(
            photographs=blocks[0].view_count,
            pixels=blocks[0].pixel_count,
            seconds=whole.stage_seconds["train"] + whole.stage_seconds.get("residual", 0.0),
            memory_bytes=whole.memory_bytes,
        )
        figures = {"seconds": whole.seconds, "memory_bytes": whole.memory_bytes}
        return {"blocks": (only,), "coarse_seconds": 0.0, **figures}
    require_blocks_possible(config)
    shares = [BlockShare(block.share, block.view_count, block.drawn_pixel_count) for block in blocks]
    costs = estimate_blocks(given, original, shares, most_gaussians, cores)
    planned = [
        PlannedBlock(
            photographs=block.view_count,
            pixels=block.pixel_count,
            seconds=cost.stage_seconds["train"],
            memory_bytes=cost.memory_bytes,
        )
        for block, cost in zip(blocks, costs.blocks, strict=True)
    ]
    return {
        "blocks": tuple(planned),
        "coarse_seconds": costs.extra_seconds,
        "seconds": costs.total.seconds,
        "memory_bytes": costs.total.memory_bytes,
    }


OPERATION = Operation(
    "plan",
    "Plan the blocks of a large capture: how many, their time and memory.",
    PlanRequest,
    PlanOptions,
    run,
)
