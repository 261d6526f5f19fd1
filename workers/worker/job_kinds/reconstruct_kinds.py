"""Kinds of jobs that reconstruct a scene: the whole of it, and one of its blocks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import Field

from octasplat.engine.blocks.block_photographs import read_block_photographs
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.block_cost import estimate_with_blocks
from octasplat.engine.operations.block_options import BlockOptions, check_block_options, parse_memory
from octasplat.engine.operations.cost_model import (
    Estimate,
    reconstruction_bytes,
    training_pixels,
)
from octasplat.engine.operations.reconstruct import OPERATION as RECONSTRUCT
from octasplat.engine.operations.reconstruct import options_from_json
from octasplat.engine.runs.config import ReconstructionConfig, revise_requested
from octasplat.engine.settings.refusals import InvalidSettingsError, Refusal
from octasplat.engine.train.config import (
    MAX_PLANNED_ITERATIONS,
    has_residual_colors,
    iteration_count,
    max_gaussian_count,
)
from octasplat.workers.worker.job_kinds.operation_kind import OperationKind
from octasplat.workers.worker.job_kinds.registry import JobKind
from octasplat.workers.worker.job_kinds.resource_limits import ResourceDemand
from octasplat.workers.worker.task import BLOCKS_FOLDER

BLOCK_KIND = "reconstruct_block"
_PROGRAMS = "octasplat.workers.worker.reconstruct_handler"


class ReconstructJobConfig(ReconstructionConfig, BlockOptions):
    """All settings of a job that reconstructs; those of blocks and the start are not settings of its run."""

    begins_with_source: bool = Field(
        False, description="Begin with the Gaussians of the job in source_id, which sets it."
    )

    def run_config(self) -> ReconstructionConfig:
        """Return the settings of the run."""
        return ReconstructionConfig.model_validate(self.model_dump(include=_RUN_FIELDS))


class BlockJobConfig(ReconstructJobConfig):
    """Settings of a job that trains a block: those of the job in blocks, and which block."""

    number: int = Field(ge=1)
    iterations: int = Field(ge=0, description="Of its training, as far as known.")
    plan: str = Field(description="Digests of what the block begins with, so that no other is taken for it.")


_RUN_FIELDS = set(ReconstructionConfig.model_fields)
_START = "begins_with_source"
"""An option, so that it outlives the source job, and a worker that does not know it leaves the job alone."""


class ReconstructKind(OperationKind):
    """Kind of jobs that reconstruct a scene from photographs."""

    export_option = "exports"
    block_kind = BLOCK_KIND
    may_start_from_result = True

    def __init__(self) -> None:
        super().__init__(
            RECONSTRUCT,
            title="Photographs to a scene, its meshes and measurements",
            stages=(),
            needs="dataset",
            complete_options=ReconstructJobConfig,
            program=f"{_PROGRAMS}:reconstruct",
            reports_stages=True,
        )

    def resolve(self, values: Mapping[str, Any]) -> ReconstructJobConfig:
        """Return complete options: those of the preset, overridden by the given ones."""
        options = options_from_json(_without_start(values))
        return _complete(
            options.config(), options.blocks, options.memory, begins_with_source=values.get(_START, False)
        )

    def revise(self, options: Mapping[str, Any], changes: Mapping[str, Any]) -> ReconstructJobConfig:
        """Return the options of a job with changes; another preset brings its own settings."""
        given = options_from_json(changes)
        blocks = {name: options.get(name) for name in BlockOptions.model_fields}
        blocks |= {name: getattr(given, name) for name in blocks if name in given.model_fields_set}
        run = {name: value for name, value in options.items() if name not in (*blocks, _START)}
        return _complete(given.revised(run), **blocks, begins_with_source=options.get(_START, False))

    def as_requested(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the given settings, those of the training by their places below ``train``."""
        options = options_from_json(_without_start(values))
        others: dict[str, Any] = {
            name: getattr(options, name)
            for name in BlockOptions.model_fields
            if name in options.model_fields_set
        }
        if values.get(_START, False):
            others[_START] = True
        return {**options.requested(), **others}

    def revise_requested(self, requested: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
        """Return the given settings with changes; another preset brings its own settings."""
        return revise_requested(requested, changes)

    def stages(self, options: ReconstructJobConfig) -> tuple[str, ...]:
        """Return the stages, those that find poses among them if there are none, nor any of a source job."""
        is_whole = options.blocks in (None, 1)  # trainings in blocks have no residual colors
        fits = is_whole and has_residual_colors(options.train)
        stages = ("load", "train", *(("residual",) if fits else ()), "evaluate", "export")
        is_posed = options.poses == "given" or options.begins_with_source
        return stages if is_posed else ("read", "features", "matches", "poses", *stages)

    def starts_from_result(self, options: ReconstructJobConfig) -> bool:
        """Return whether the training begins with the Gaussians of the source job."""
        return options.begins_with_source

    def with_start(self, options: ReconstructJobConfig) -> ReconstructJobConfig:
        """Return the options of a training that begins with the Gaussians of the source job, in one piece."""
        return _complete(options.run_config(), options.blocks, options.memory, begins_with_source=True)

    def needs_poses(self, options: ReconstructJobConfig) -> bool:
        """Return whether the dataset must hold a COLMAP model."""
        return options.poses == "given"

    def with_poses_known(self, options: ReconstructJobConfig, has_poses: bool) -> ReconstructionConfig:
        """Return the options with poses decided, so that no job shows stages that it will not have."""
        return options.with_poses_decided(has_poses)

    def is_resumable_with(self, old: ReconstructJobConfig, new: ReconstructJobConfig) -> bool:
        """Return whether only the files differ, which are written after everything else."""
        return old.model_copy(update={"exports": new.exports}) == new

    def exported_files(self, options: ReconstructJobConfig) -> tuple[str, ...]:
        """Return the names of the files to export."""
        return options.exports

    def options_of_block(
        self, options: ReconstructJobConfig, number: int, iterations: int, plan: str
    ) -> dict[str, Any]:
        """Return the options of a block's job; files are exported by the whole job only."""
        own = {"exports": [], "number": number, "iterations": iterations, "plan": plan}
        return {**options.model_dump(mode="json"), **own}

    def resource_demands(
        self, options: ReconstructJobConfig, sizes: Sequence[ImageSizes]
    ) -> tuple[ResourceDemand, ...]:
        """Return the resource demands of the training."""
        train = options.train
        pixels = training_pixels(options, sizes)
        gaussians = max_gaussian_count(train, pixels)
        # With a limit of time the count is not known before; the most that may be planned is demanded.
        iterations = MAX_PLANNED_ITERATIONS if options.minutes else iteration_count(train, pixels)
        return (
            ResourceDemand("train.iterations", "iterations", iterations),
            ResourceDemand("train.max_gaussians", "gaussians", gaussians),
            ResourceDemand("train.rays_per_batch", "rays", train.rays_per_batch),
            ResourceDemand("train.probe_rays", "rays", train.probe_rays),
            ResourceDemand("train.ray_patch_rays", "rays", train.ray_patch_rays),
            ResourceDemand("train.ssim_patch_side", "rays", train.ssim_patch_side**2),
            ResourceDemand("max_side", "side_px", options.max_side or 0),
            ResourceDemand("exports", "exports", len(options.exports)),
            ResourceDemand("max_side", "workspace_bytes", reconstruction_bytes(options, sizes)),
        )

    def estimate(self, options: ReconstructJobConfig, sizes: Sequence[ImageSizes], cores: int) -> Estimate:
        """Return the time that it takes as a whole, also in blocks, and the memory: of a block if given."""
        found = estimate_with_blocks(options, options, sizes, cores)
        if options.memory is None:
            return found
        memory_bytes = min(found.memory_bytes, parse_memory(options.memory))
        return found.model_copy(update={"memory_bytes": memory_bytes})


class BlockKind(JobKind[BlockJobConfig]):
    """Kind of jobs that train one block; only a job in blocks queues them."""

    is_internal = True

    def __init__(self) -> None:
        super().__init__(
            name=BLOCK_KIND,
            title="One block of a scene",
            needs="dataset",
            options=BlockJobConfig,
            program=f"{_PROGRAMS}:train_block",
            stages=("load", "train"),
        )

    def needed_files(self, options: BlockJobConfig, run: Path, names: Sequence[str]) -> set[str] | None:
        """Return the photographs that the plan gives the block; None where the plan is one of old."""
        known = read_block_photographs(run / BLOCKS_FOLDER)
        return None if known is None else known.needed_files(options.number, names)


def given_settings(requested: Mapping[str, Any] | None) -> tuple[str, ...] | None:
    """Return the names of the settings of its run that a job was given.

    Args:
        requested: the options as they were asked for, or None.

    Returns:
        The names; None where they are not known, as of a job of another version.
    """
    if requested is None:
        return None
    try:
        return options_from_json(_without_start(requested)).given()
    except InvalidSettingsError:
        return None


def _complete(
    config: ReconstructionConfig,
    blocks: Any = None,
    memory: str | None = None,
    *,
    begins_with_source: bool = False,
) -> ReconstructJobConfig:
    """Return the settings of a job: those of its run, of its blocks, and what it begins with."""
    check_block_options(BlockOptions(blocks=blocks, memory=memory), config)
    if config.without_run_of_model()[1] is not None:
        detail = (
            "A job finds the models itself and knows no folders of other machines; name one without a folder "
            "before it, such as poses/1."
        )
        raise InvalidSettingsError([Refusal(("model",), "model", detail)])
    others = {"blocks": blocks, "memory": memory, _START: begins_with_source}
    job = ReconstructJobConfig.model_validate({**config.model_dump(mode="json"), **others})
    if job.begins_with_source and job.blocks is not None:
        detail = "A scene that is trained in blocks begins anew; leave blocks out, or the job to begin with."
        raise InvalidSettingsError([Refusal(("blocks",), "blocks", detail)])
    return job


def _without_start(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return options without what only jobs have."""
    return {name: value for name, value in values.items() if name != _START}
