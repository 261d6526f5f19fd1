"""The kinds that octasplat brings."""

from collections.abc import Mapping, Sequence
from typing import Any

from octasplat.engine.config import ReconstructionConfig
from octasplat.engine.operations.base import Options
from octasplat.engine.operations.clean import OPERATION as CLEAN
from octasplat.engine.operations.costs import (
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
from octasplat.engine.operations.reconstruct import options_of
from octasplat.engine.operations.relight import OPERATION as RELIGHT
from octasplat.engine.operations.render import OPERATION as RENDER
from octasplat.engine.operations.stage_init import OPERATION as STAGE_INIT
from octasplat.engine.operations.transform import OPERATION as TRANSFORM
from octasplat.engine.photograph_sizes import Sizes
from octasplat.engine.train.config import MOST_PLANNED_ITERATIONS, iteration_count, most_gaussians
from octasplat.workers.work.kinds.demands import Demand
from octasplat.workers.work.kinds.operation_kind import OperationKind
from octasplat.workers.work.kinds.pictures import Relight, Render
from octasplat.workers.work.kinds.scene_kinds import (
    BACKGROUND,
    EDITS,
    EXACT_LIGHT,
    LIGHT,
    RUN_FILES,
    Export,
    Import,
    SceneChange,
)
from octasplat.workers.work.kinds.surface import Surface
from octasplat.workers.work.kinds.table import register
from octasplat.workers.work.task import FACTS, Task


class Reconstruct(OperationKind):
    """Photographs to a scene."""

    writes_at = "exports"

    def resolve(self, asked: Mapping[str, Any]) -> ReconstructionConfig:
        """Return complete options: those of the preset, and what was asked for on top."""
        return options_of(asked).config()

    def revised(self, before: Mapping[str, Any], changes: Mapping[str, Any]) -> ReconstructionConfig:
        """Return the options of a job with changes; another preset brings its own settings."""
        return options_of(changes).revised(before)

    def stages(self, options: ReconstructionConfig) -> tuple[str, ...]:
        """Return the stages, those that find poses among them if there are none."""
        stages = ("load", "train", "evaluate", "export")
        return stages if options.poses == "given" else ("features", "matches", "poses", *stages)

    def needs_poses(self, options: ReconstructionConfig) -> bool:
        """Return whether the dataset must hold a COLMAP model."""
        return options.poses == "given"

    def settle(self, options: ReconstructionConfig, has_poses: bool) -> ReconstructionConfig:
        """Return the options with poses decided, so that no job shows stages that it will not have."""
        return options.with_poses_decided(has_poses)

    def goes_on(self, before: ReconstructionConfig, after: ReconstructionConfig) -> bool:
        """Return whether only the files differ, which are written after everything else."""
        return before.model_copy(update={"exports": after.exports}) == after

    def writes(self, options: ReconstructionConfig) -> tuple[str, ...]:
        """Return the names of the files to export."""
        return options.exports

    def demands(self, options: ReconstructionConfig, sizes: Sequence[Sizes]) -> tuple[Demand, ...]:
        """Return what the training asks for."""
        train = options.train
        pixels = training_pixels(options, sizes)
        gaussians = most_gaussians(train, pixels)
        iterations = MOST_PLANNED_ITERATIONS if options.minutes else iteration_count(train, pixels)
        return (
            Demand("train.iterations", "iterations", iterations),
            Demand("train.max_gaussians", "gaussians", gaussians),
            Demand("train.rays_per_batch", "rays", train.rays_per_batch),
            Demand("train.probe_rays", "rays", train.probe_rays),
            Demand("train.ray_patch_rays", "rays", train.ray_patch_rays),
            Demand("train.ssim_patch_side", "rays", train.ssim_patch_side**2),
            Demand("max_side", "side_px", options.max_side or 0),
            Demand("exports", "exports", len(options.exports)),
            Demand("max_side", "workspace_bytes", reconstruction_bytes(options, sizes)),
        )

    def estimate(self, options: ReconstructionConfig, sizes: Sequence[Sizes], cores: int) -> Estimate:
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


class Info(OperationKind):
    """What is in a scene."""

    def places(self, task: Task, options: Any) -> dict[str, Any]:
        """Return the scene and the files that tell what is in it; paths are taken out of the facts."""
        return {
            "source": task.source,
            "output": task.folder / FACTS,
            "picture": task.results / "picture.png",
        }


def register_all() -> None:
    """Register them."""
    register(
        Reconstruct(
            RECONSTRUCT,
            title="Photographs to a scene, its meshes and measurements",
            stages=(),
            needs="dataset",
            complete=ReconstructionConfig,
            program="octasplat.workers.work.programs:reconstruct",
            tells_stages=True,
        )
    )
    register(
        Evaluate(
            EVALUATE,
            title="Measure views of a reconstruction: those held out again, or other photographs",
            stages=("evaluate",),
            source_files=(*RUN_FILES, LIGHT, EXACT_LIGHT, BACKGROUND, EDITS),
            tells_stages=True,
        )
    )
    register(Export())
    register(
        Render(
            RENDER,
            title="New views of the scene of a reconstruction, as a video or images",
            source_files=(*RUN_FILES[:4], BACKGROUND),
        )
    )
    register(
        Relight(
            RELIGHT,
            title="The scene of a reconstruction with materials in other light",
            source_files=(LIGHT, *RUN_FILES[:4]),
        )
    )
    register(
        OperationKind(
            STAGE_INIT,
            title="A commented stage that fits the scene of a reconstruction",
            stages=("read",),
            source_files=(*RUN_FILES[:4], BACKGROUND),
            output="stage.toml",
        )
    )
    register(SceneChange(MATERIAL, title="The scene of a reconstruction with other materials", first=LIGHT))
    register(
        Info(
            INFO,
            title="What is in the scene of a reconstruction: counts, bounds, sizes, cost",
            stages=("read",),
            source_files=(*RUN_FILES[:4], BACKGROUND),
        )
    )
    register(Surface())
    register(SceneChange(CROP))
    register(SceneChange(CLEAN))
    register(SceneChange(TRANSFORM, keeps_world=False))
    register(SceneChange(EDIT, sequence="meshes"))
    register(SceneChange(DEFORM, sequence="deformed"))
    register(SceneChange(MERGE))
    register(Import())
