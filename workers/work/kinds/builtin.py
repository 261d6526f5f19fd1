"""The kinds that octasplat brings."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from octasplat.engine.operations.base import Options
from octasplat.engine.operations.crop import OPERATION as CROP
from octasplat.engine.operations.evaluate import OPERATION as EVALUATE
from octasplat.engine.operations.material import OPERATION as MATERIAL
from octasplat.engine.operations.relight import OPERATION as RELIGHT
from octasplat.engine.operations.render import OPERATION as RENDER
from octasplat.engine.train.config import MOST_PLANNED_ITERATIONS, iteration_count, most_gaussians
from octasplat.workers.records.sizes import Sizes
from octasplat.workers.work.kinds.demands import Demand
from octasplat.workers.work.kinds.estimates import (
    Estimate,
    estimate_reconstruction,
    reconstruction_bytes,
    training_pixels,
)
from octasplat.workers.work.kinds.operation_kind import OperationKind
from octasplat.workers.work.kinds.options import (
    ExportJobOptions,
    ReconstructOptions,
    resolve_reconstruction,
    revise_reconstruction,
)
from octasplat.workers.work.kinds.pictures import Relight, Render
from octasplat.workers.work.kinds.surface import Surface
from octasplat.workers.work.kinds.table import JobKind, register
from octasplat.workers.work.task import Task

_RUN_FILES = ("scene.ply", "config.json", "held_out.json", "views.json", "training.json", "events.jsonl")
_LIGHT = "environment.hdr"
"""What results with materials have, and no others."""
_BACKGROUND = "background.exr"
"""What results with a learnt background have, and no others."""


class Reconstruct(JobKind[ReconstructOptions]):
    """Photographs to a scene."""

    writes_at = "exports"

    def resolve(self, asked: Mapping[str, Any]) -> ReconstructOptions:
        """Return complete options: those of the preset, and what was asked for on top."""
        return resolve_reconstruction(asked)

    def revised(self, before: Mapping[str, Any], changes: Mapping[str, Any]) -> ReconstructOptions:
        """Return the options of a job with changes; another preset brings its own settings."""
        return revise_reconstruction(before, changes)

    def stages(self, options: ReconstructOptions) -> tuple[str, ...]:
        """Return the stages, those that find poses among them if there are none."""
        stages = ("load", "train", "evaluate", "export")
        return stages if options.poses == "given" else ("features", "matches", "poses", *stages)

    def needs_poses(self, options: ReconstructOptions) -> bool:
        """Return whether the dataset must hold a COLMAP model."""
        return options.poses == "given"

    def settle(self, options: ReconstructOptions, has_poses: bool) -> ReconstructOptions:
        """Return the options with poses decided, so that no job shows stages that it will not have."""
        if options.poses != "missing":
            return options
        return options.model_copy(update={"poses": "given" if has_poses else "auto"})

    def goes_on(self, before: ReconstructOptions, after: ReconstructOptions) -> bool:
        """Return whether only the files differ, which are written after everything else."""
        return before.model_copy(update={"exports": after.exports}) == after

    def writes(self, options: ReconstructOptions) -> tuple[str, ...]:
        """Return the names of the files to export."""
        return options.exports

    def demands(self, options: ReconstructOptions, sizes: Sequence[Sizes]) -> tuple[Demand, ...]:
        """Return what the training asks for."""
        train = options.train
        pixels = training_pixels(options, sizes)
        gaussians = most_gaussians(train, pixels)
        iterations = MOST_PLANNED_ITERATIONS if options.minutes else iteration_count(train, pixels)
        return (
            Demand("train.iterations", "iterations", iterations),
            Demand("train.max_gaussians", "gaussians", gaussians),
            Demand("train.rays", "rays", train.rays),
            Demand("train.probe_rays", "rays", train.probe_rays),
            Demand("train.window_rays", "rays", train.window_rays),
            Demand("train.patch_side", "rays", train.patch_side**2),
            Demand("max_side", "side_px", options.max_side or 0),
            Demand("exports", "exports", len(options.exports)),
            Demand("max_side", "workspace_bytes", reconstruction_bytes(options, sizes)),
        )

    def estimate(self, options: ReconstructOptions, sizes: Sequence[Sizes], cores: int) -> Estimate:
        """Return the time and memory that it takes."""
        return estimate_reconstruction(options, sizes, cores)


class Evaluate(OperationKind):
    """Views measured."""

    takes_other_photographs = True

    def needs_photographs(self, options: Options) -> bool:
        """Return True: views are compared with photographs."""
        return True

    def on_other_photographs(self, options: Options) -> Options:
        """Return the options for photographs of which none was trained on."""
        return options.model_copy(update={"all_views": True})


class Export(JobKind[ExportJobOptions]):
    """A scene in other formats."""

    writes_at = "files"

    def writes(self, options: ExportJobOptions) -> tuple[str, ...]:
        """Return the names of the files."""
        return options.files

    def demands(self, options: ExportJobOptions, sizes: Sequence[Sizes]) -> tuple[Demand, ...]:
        """Return the number of files."""
        return (Demand("files", "exports", len(options.files)),)


class Material(OperationKind):
    """Other materials."""

    def places(self, task: Task, options: Any) -> dict[str, Path]:
        """Return the run, and the folder of the run that comes of it, which is published file by file."""
        return {"source": task.run, "output": task.folder / "changed"}


def register_all() -> None:
    """Register them."""
    register(
        Reconstruct(
            name="reconstruct",
            title="Photographs to a scene, its meshes and measurements",
            needs="dataset",
            options=ReconstructOptions,
            program="octasplat.workers.work.programs:reconstruct",
        )
    )
    register(
        Evaluate(
            EVALUATE,
            title="Measure views of a reconstruction: those held out again, or other photographs",
            stages=("evaluate",),
            source_files=(*_RUN_FILES, _LIGHT, _BACKGROUND, "edits.json"),
            tells_stages=True,
        )
    )
    register(
        Export(
            name="export",
            title="The scene of a reconstruction in other formats",
            needs="result",
            options=ExportJobOptions,
            program="octasplat.workers.work.programs:export",
            stages=("export",),
            source_files=("scene.ply", "config.json"),
        )
    )
    register(
        Render(
            RENDER,
            title="New views of the scene of a reconstruction, as a video or images",
            source_files=(*_RUN_FILES[:4], _BACKGROUND),
        )
    )
    register(
        Relight(
            RELIGHT,
            title="The scene of a reconstruction with materials in other light",
            source_files=(_LIGHT, *_RUN_FILES[:4]),
        )
    )
    register(
        Material(
            MATERIAL,
            title="The scene of a reconstruction with other materials",
            stages=("edit",),
            source_files=(_LIGHT, *_RUN_FILES, "edits.json"),
        )
    )
    register(Surface())
    register(OperationKind(CROP, stages=("edit",)))
