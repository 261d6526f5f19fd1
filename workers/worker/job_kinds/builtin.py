"""The built-in kinds of jobs; imported when the table of kinds is first asked for one of them."""

from typing import Any

from octasplat.engine.core.georeference import GEOREFERENCE_FILE
from octasplat.engine.operations.base import Options
from octasplat.engine.operations.clean import OPERATION as CLEAN
from octasplat.engine.operations.crop import OPERATION as CROP
from octasplat.engine.operations.deform import OPERATION as DEFORM
from octasplat.engine.operations.edit import OPERATION as EDIT
from octasplat.engine.operations.evaluate import OPERATION as EVALUATE
from octasplat.engine.operations.info import OPERATION as INFO
from octasplat.engine.operations.material import OPERATION as MATERIAL
from octasplat.engine.operations.merge import OPERATION as MERGE
from octasplat.engine.operations.relight import OPERATION as RELIGHT
from octasplat.engine.operations.render import OPERATION as RENDER
from octasplat.engine.operations.simplify import OPERATION as SIMPLIFY
from octasplat.engine.operations.stage_init import OPERATION as STAGE_INIT
from octasplat.engine.operations.transform import OPERATION as TRANSFORM
from octasplat.workers.worker.job_kinds.image_kinds import RelightKind, RenderKind
from octasplat.workers.worker.job_kinds.operation_kind import OperationKind
from octasplat.workers.worker.job_kinds.reconstruct_kinds import BlockKind, ReconstructKind
from octasplat.workers.worker.job_kinds.registry import JobKind
from octasplat.workers.worker.job_kinds.scene_kinds import (
    BACKGROUND_FILE,
    EDITS_FILE,
    EXACT_LIGHT_FILE,
    LIGHT_FILE,
    RESIDUAL_FILE,
    RUN_FILES,
    ExportKind,
    ImportKind,
    SceneEditKind,
)
from octasplat.workers.worker.job_kinds.surface_kind import SurfaceKind
from octasplat.workers.worker.task import INFO_FILE, Task


class EvaluateKind(OperationKind):
    """Kind of jobs that evaluate views."""

    takes_other_photographs = True

    def needs_photographs(self, options: Options) -> bool:
        """Return True: views are compared with photographs."""
        return True

    def for_other_photographs(self, options: Options) -> Options:
        """Return the options for photographs of which none was trained on."""
        return options.model_copy(update={"all_views": True})


class StageInitKind(OperationKind):
    """Kind of jobs that write a first stage."""

    def request_paths(self, task: Task, options: Any) -> dict[str, Any]:
        """Return the scene and the stage, beside which the map of light that it names is put."""
        return {**super().request_paths(task, options), "copy_light": True}


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
    ReconstructKind(),
    BlockKind(),
    EvaluateKind(
        EVALUATE,
        title="Measure views of a reconstruction: those held out again, or other photographs",
        stages=("evaluate",),
        source_files=(
            *RUN_FILES,
            *(LIGHT_FILE, EXACT_LIGHT_FILE, RESIDUAL_FILE, BACKGROUND_FILE, EDITS_FILE, GEOREFERENCE_FILE),
        ),
        reports_stages=True,
    ),
    ExportKind(),
    RenderKind(
        RENDER,
        title="New views of the scene of a reconstruction, as a video or images",
        source_files=(*RUN_FILES[:4], LIGHT_FILE, EXACT_LIGHT_FILE, RESIDUAL_FILE, BACKGROUND_FILE),
    ),
    RelightKind(
        RELIGHT,
        title="The scene of a reconstruction with materials in other light",
        source_files=(LIGHT_FILE, *RUN_FILES[:4]),
    ),
    StageInitKind(
        STAGE_INIT,
        title="A commented stage that fits the scene of a reconstruction",
        stages=("read",),
        source_files=(*RUN_FILES[:4], LIGHT_FILE, EXACT_LIGHT_FILE, BACKGROUND_FILE),
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
