"""Kinds of jobs that read scenes and write them: export, import, and those that change a scene."""

from collections.abc import Sequence
from typing import Any

from octasplat.engine.operations.base import Operation, Options
from octasplat.engine.operations.export import OPERATION as EXPORT
from octasplat.engine.operations.export import ExportJobOptions
from octasplat.engine.operations.import_ import OPERATION as IMPORT
from octasplat.engine.photograph_sizes import Sizes
from octasplat.workers.work.kinds.demands import Demand
from octasplat.workers.work.kinds.operation_kind import OperationKind
from octasplat.workers.work.task import CONFIG_FILE, SCENE_FILE, Task

RUN_FILES = (SCENE_FILE, CONFIG_FILE, "held_out.json", "views.json", "training.json", "events.jsonl")
LIGHT, EXACT_LIGHT = "environment.hdr", "environment.exr"
"""What results with materials have, and no others."""
BACKGROUND = "background.exr"
"""What results with a learnt background have, and no others."""
EDITS = "edits.json"
CHANGED = "changed"
"""In the attempt's folder, the run that a job makes of its source's."""


class Export(OperationKind):
    """A scene in other formats."""

    writes_at = "files"

    def __init__(self) -> None:
        super().__init__(
            EXPORT,
            title="The scene of a reconstruction in other formats",
            stages=("export",),
            source_files=(SCENE_FILE, CONFIG_FILE, "views.json"),
        )

    def places(self, task: Task, options: Any) -> dict[str, Any]:
        """Return where a job reads and writes, by the names of the request."""
        return {
            **super().places(task, options),
            "files": [task.results / name for name in self.writes(options)],
        }

    def writes(self, options: Options) -> tuple[str, ...]:
        """Return the names of the files."""
        assert isinstance(options, ExportJobOptions)
        return options.files

    def demands(self, options: Options, sizes: Sequence[Sizes]) -> tuple[Demand, ...]:
        """Return the number of files."""
        return (Demand("files", "exports", len(self.writes(options))),)


class Import(OperationKind):
    """A scene of another program; it needs nothing but files that are sent."""

    def __init__(self) -> None:
        super().__init__(IMPORT, stages=("read",), needs="files", source_files=(), tells_stages=True)


class SceneChange(OperationKind):
    """A kind of job that makes another scene of that of its source.

    The results are like those of a run where the source's are, so that every job that works on a run works on
    them; else they are the scene alone. A sequence of scenes is one of numbered files.

    Args:
        operation: what it does.
        title: one line for people; None takes that of the operation.
        first: result of the source job without which it cannot be asked for.
        sequence: option that names the meshes of which each makes a scene.
        keeps_world: whether the result stands where the photographs show it.
    """

    def __init__(
        self,
        operation: Operation[Any, Any],
        *,
        title: str | None = None,
        first: str = SCENE_FILE,
        sequence: str | None = None,
        keeps_world: bool = True,
    ) -> None:
        files = dict.fromkeys((first, *RUN_FILES, LIGHT, EXACT_LIGHT, BACKGROUND, EDITS))
        super().__init__(operation, title=title, stages=("edit",), source_files=tuple(files))
        self.keeps_world = keeps_world
        self._sequence = sequence

    def places(self, task: Task, options: Any) -> dict[str, Any]:
        """Return where a job reads and writes, by the names of the request."""
        places = super().places(task, options)
        if self._sequence is not None and len(getattr(options, self._sequence)) > 1:
            return {**places, "output": task.results / "scene_%04d.ply"}
        if task.source.is_dir():
            return {**places, "output": task.folder / CHANGED}
        return places
