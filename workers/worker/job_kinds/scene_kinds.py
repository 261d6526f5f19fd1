"""Kinds of jobs that read and write scenes: export, import, and edits."""

from collections.abc import Sequence
from typing import Any

from octasplat.engine.core.georeference import GEOREFERENCE_FILE
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.base import Operation, Options
from octasplat.engine.operations.export import OPERATION as EXPORT
from octasplat.engine.operations.export import ExportJobOptions
from octasplat.engine.operations.import_ import OPERATION as IMPORT
from octasplat.workers.worker.job_kinds.operation_kind import OperationKind
from octasplat.workers.worker.job_kinds.resource_limits import ResourceDemand
from octasplat.workers.worker.task import CONFIG_FILE, SCENE_FILE, Task

RUN_FILES = (SCENE_FILE, CONFIG_FILE, "held_out.json", "views.json", "training.json", "events.jsonl")
LIGHT_FILE, EXACT_LIGHT_FILE = "environment.hdr", "environment.exr"
"""What results with materials have, and no others."""
BACKGROUND_FILE = "background.exr"
"""What results with a learnt background have, and no others."""
RESIDUAL_FILE = "residual.npz"
"""What results with materials and residual colors have."""
EDITS_FILE = "edits.json"
CHANGED_FOLDER = "changed"
"""In the attempt's folder, the run that a job makes of its source's."""


class ExportKind(OperationKind):
    """Kind of jobs that write a scene in other formats."""

    export_option = "files"

    def __init__(self) -> None:
        super().__init__(
            EXPORT,
            title="The scene of a reconstruction in other formats",
            stages=("export",),
            source_files=(SCENE_FILE, CONFIG_FILE, "views.json", GEOREFERENCE_FILE),
        )

    def request_paths(self, task: Task, options: Any) -> dict[str, Any]:
        """Return where a job reads and writes, by the names of the request."""
        return {
            **super().request_paths(task, options),
            "files": [task.results / name for name in self.exported_files(options)],
        }

    def exported_files(self, options: Options) -> tuple[str, ...]:
        """Return the names of the files."""
        assert isinstance(options, ExportJobOptions)
        return options.files

    def resource_demands(self, options: Options, sizes: Sequence[ImageSizes]) -> tuple[ResourceDemand, ...]:
        """Return the number of files."""
        return (ResourceDemand("files", "exports", len(self.exported_files(options))),)


class ImportKind(OperationKind):
    """Kind of jobs that read a scene of another program from uploaded files."""

    def __init__(self) -> None:
        super().__init__(IMPORT, stages=("read",), needs="files", source_files=(), reports_stages=True)


class SceneEditKind(OperationKind):
    """A kind of job that makes another scene of that of its source.

    The results are like those of a run where the source's are, so that every job that works on a run works on
    them; else they are the scene alone. A sequence of scenes is one of numbered files.

    Args:
        operation: what it does.
        title: one line for people; None takes that of the operation.
        required_file: result of the source job without which it cannot be asked for.
        sequence_option: option that names the meshes of which each makes a scene.
        keeps_world_frame: whether the result stands where the photographs show it.
    """

    def __init__(
        self,
        operation: Operation[Any, Any],
        *,
        title: str | None = None,
        required_file: str = SCENE_FILE,
        sequence_option: str | None = None,
        keeps_world_frame: bool = True,
    ) -> None:
        light = (LIGHT_FILE, EXACT_LIGHT_FILE, BACKGROUND_FILE)
        files = dict.fromkeys((required_file, *RUN_FILES, *light, EDITS_FILE, GEOREFERENCE_FILE))
        super().__init__(operation, title=title, stages=("edit",), source_files=tuple(files))
        self.keeps_world_frame = keeps_world_frame
        self._sequence_option = sequence_option

    def request_paths(self, task: Task, options: Any) -> dict[str, Any]:
        """Return where a job reads and writes, by the names of the request."""
        places = super().request_paths(task, options)
        if self._sequence_option is not None and len(getattr(options, self._sequence_option)) > 1:
            return {**places, "output": task.results / "scene_%04d.ply"}
        if task.source.is_dir():
            return {**places, "output": task.folder / CHANGED_FOLDER}
        return places
