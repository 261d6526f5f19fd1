"""The built-in kinds of jobs; imported when the table of kinds is first asked for one of them."""

from collections.abc import Mapping, Sequence
from typing import Any

from octasplat.engine.core.georeference import GEOREFERENCE_FILE
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.base import Options
from octasplat.engine.operations.clean import OPERATION as CLEAN
from octasplat.engine.operations.cost_model import (
    Estimate,
    estimate_reconstruction,
    reconstruction_bytes,
    training_pixels,
)
from octasplat.engine.operations.crop import OPERATION as CROP
from octasplat.engine.operations.deform import OPERATION as DEFORM
from octasplat.engine.operations.edit import OPERATION as EDIT
from octasplat.engine.operations.evaluate import OPERATION as EVALUATE
from octasplat.engine.operations.info import OPERATION as INFO
from octasplat.engine.operations.material import OPERATION as MATERIAL
from octasplat.engine.operations.merge import OPERATION as MERGE
from octasplat.engine.operations.reconstruct import OPERATION as RECONSTRUCT
from octasplat.engine.operations.reconstruct import options_from_json
from octasplat.engine.operations.relight import OPERATION as RELIGHT
from octasplat.engine.operations.render import OPERATION as RENDER
from octasplat.engine.operations.simplify import OPERATION as SIMPLIFY
from octasplat.engine.operations.stage_init import OPERATION as STAGE_INIT
from octasplat.engine.operations.transform import OPERATION as TRANSFORM
from octasplat.engine.runs.config import ReconstructionConfig, revise_requested
from octasplat.engine.train.config import MAX_PLANNED_ITERATIONS, iteration_count, max_gaussian_count
from octasplat.workers.worker.job_kinds.image_kinds import RelightKind, RenderKind
from octasplat.workers.worker.job_kinds.operation_kind import OperationKind
from octasplat.workers.worker.job_kinds.registry import JobKind
from octasplat.workers.worker.job_kinds.resource_limits import ResourceDemand
from octasplat.workers.worker.job_kinds.scene_kinds import (
    BACKGROUND_FILE,
    EDITS_FILE,
    EXACT_LIGHT_FILE,
    LIGHT_FILE,
    RUN_FILES,
    ExportKind,
    ImportKind,
    SceneEditKind,
)
from octasplat.workers.worker.job_kinds.surface_kind import SurfaceKind
from octasplat.workers.worker.task import INFO_FILE, Task


class ReconstructKind(OperationKind):
    """Kind of jobs that reconstruct a scene from photographs."""

    export_option = "exports"

    def resolve(self, values: Mapping[str, Any]) -> ReconstructionConfig:
        """Return complete options: those of the preset, overridden by the given ones."""
        return options_from_json(values).config()

    def revise(self, options: Mapping[str, Any], changes: Mapping[str, Any]) -> ReconstructionConfig:
        """Return the options of a job with changes; another preset brings its own settings."""
        return options_from_json(changes).revised(options)

    def as_requested(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the given settings, those of the training by their places below ``train``."""
        return options_from_json(values).requested()

    def revise_requested(self, requested: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
        """Return the given settings with changes; another preset brings its own settings."""
        return revise_requested(requested, changes)

    def stages(self, options: ReconstructionConfig) -> tuple[str, ...]:
        """Return the stages, those that find poses among them if there are none."""
        stages = ("load", "train", "evaluate", "export")
        return stages if options.poses == "given" else ("features", "matches", "poses", *stages)

    def needs_poses(self, options: ReconstructionConfig) -> bool:
        """Return whether the dataset must hold a COLMAP model."""
        return options.poses == "given"

    def with_poses_known(self, options: ReconstructionConfig, has_poses: bool) -> ReconstructionConfig:
        """Return the options with poses decided, so that no job shows stages that it will not have."""
        return options.with_poses_decided(has_poses)

    def is_resumable_with(self, old: ReconstructionConfig, new: ReconstructionConfig) -> bool:
        """Return whether only the files differ, which are written after everything else."""
        return old.model_copy(update={"exports": new.exports}) == new

    def exported_files(self, options: ReconstructionConfig) -> tuple[str, ...]:
        """Return the names of the files to export."""
        return options.exports

    def resource_demands(
        self, options: ReconstructionConfig, sizes: Sequence[ImageSizes]
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

    def estimate(self, options: ReconstructionConfig, sizes: Sequence[ImageSizes], cores: int) -> Estimate:
        """Return the time and memory that it takes."""
        return estimate_reconstruction(options, sizes, cores)


class EvaluateKind(OperationKind):
    """Kind of jobs that evaluate views."""

    takes_other_photographs = True

    def needs_photographs(self, options: Options) -> bool:
        """Return True: views are compared with photographs."""
        return True

    def for_other_photographs(self, options: Options) -> Options:
        """Return the options for photographs of which none was trained on."""
        return options.model_copy(update={"all_views": True})


class InfoKind(OperationKind):
    """Kind of jobs that describe a scene."""

    def request_paths(self, task: Task, options: Any) -> dict[str, Any]:
        """Return the scene and the files that tell what is in it; paths are taken out of the facts."""
        return {
            "source": task.source,
            "output": task.folder / INFO_FILE,
            "picture": task.results / "picture.png",
        }


BUILTIN_KINDS: tuple[JobKind[Any], ...] = (
    ReconstructKind(
        RECONSTRUCT,
        title="Photographs to a scene, its meshes and measurements",
        stages=(),
        needs="dataset",
        complete_options=ReconstructionConfig,
        program="octasplat.workers.worker.reconstruct_handler:reconstruct",
        reports_stages=True,
    ),
    EvaluateKind(
        EVALUATE,
        title="Measure views of a reconstruction: those held out again, or other photographs",
        stages=("evaluate",),
        source_files=(
            *RUN_FILES,
            *(LIGHT_FILE, EXACT_LIGHT_FILE, BACKGROUND_FILE, EDITS_FILE, GEOREFERENCE_FILE),
        ),
        reports_stages=True,
    ),
    ExportKind(),
    RenderKind(
        RENDER,
        title="New views of the scene of a reconstruction, as a video or images",
        source_files=(*RUN_FILES[:4], LIGHT_FILE, EXACT_LIGHT_FILE, BACKGROUND_FILE),
    ),
    RelightKind(
        RELIGHT,
        title="The scene of a reconstruction with materials in other light",
        source_files=(LIGHT_FILE, *RUN_FILES[:4]),
    ),
    OperationKind(
        STAGE_INIT,
        title="A commented stage that fits the scene of a reconstruction",
        stages=("read",),
        source_files=(*RUN_FILES[:4], BACKGROUND_FILE),
        output="stage.toml",
    ),
    SceneEditKind(
        MATERIAL, title="The scene of a reconstruction with other materials", required_file=LIGHT_FILE
    ),
    InfoKind(
        INFO,
        title="What is in the scene of a reconstruction: counts, bounds, sizes, cost",
        stages=("read",),
        source_files=(*RUN_FILES[:4], BACKGROUND_FILE, GEOREFERENCE_FILE),
    ),
    SurfaceKind(),
    SceneEditKind(CROP),
    SceneEditKind(CLEAN),
    SceneEditKind(SIMPLIFY),
    SceneEditKind(TRANSFORM, keeps_world_frame=False),
    SceneEditKind(EDIT, sequence_option="meshes"),
    SceneEditKind(DEFORM, sequence_option="deformed"),
    SceneEditKind(MERGE),
    ImportKind(),
)
