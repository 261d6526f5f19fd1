"""Kinds of jobs that run an operation of the engine."""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from octasplat.engine.core.events import EventListener
from octasplat.engine.core.portable_names import check_name
from octasplat.engine.core.progress import stop_when_asked
from octasplat.engine.operations.base import Operation, Options, Request
from octasplat.engine.settings.fields import accepts_files, iter_named_files, map_named_files
from octasplat.workers.worker.job_kinds.registry import JobKind, Needs
from octasplat.workers.worker.task import SCENE_FILE, Task

PROGRAM = "octasplat.workers.worker.handlers:run_operation"


class OperationKind(JobKind[Any]):
    """A kind of job that runs an operation, with the operation's options.

    Args:
        operation: what it does.
        title: one line for people; None takes that of the operation.
        options: class of its options, where a job has more than the operation.
        stages: names of its stages.
        source_files: results of the source job that it reads.
        output: name of the file or folder, among the results, that the request calls its output.
        needs: what it works on.
        reports_stages: whether the operation tells its stages itself.
        complete_options: model of the complete options, if they are not those that users give.
    """

    def __init__(
        self,
        operation: Operation[Any, Any],
        *,
        title: str | None = None,
        options: type[Options] | None = None,
        stages: Sequence[str],
        source_files: Sequence[str] = (SCENE_FILE, "config.json"),
        output: str = SCENE_FILE,
        needs: Needs = "result",
        program: str = PROGRAM,
        reports_stages: bool = False,
        complete_options: type[BaseModel] | None = None,
    ) -> None:
        super().__init__(
            name=operation.name,
            title=title or operation.title.removesuffix("."),
            needs=needs,
            options=complete_options or options or operation.options,
            user_options=options or operation.options,
            program=program,
            stages=stages,
            source_files=source_files,
        )
        self.operation = operation
        self.takes_files = accepts_files(self.options)
        self.reports_stages = reports_stages
        self._output = output

    def named_files(self, options: Any) -> Iterable[tuple[str, str]]:
        """Return the files that the options name."""
        return ((place, path.as_posix()) for place, path in iter_named_files(options))

    def build_request(self, task: Task) -> Request:
        """Return the request of a job, whose files lie in the task's folders.

        Raises:
            ConfigError: an option names a file that is outside of them.
        """
        options = self.resolve(task.options)
        values = map_named_files(options, lambda path: task.files / check_name(path.as_posix()))
        fields = self.operation.request.model_fields
        known = {name: value for name, value in values.items() if name in fields}
        if "overwrite" in fields:  # the folder is the job's own, with what its earlier attempts have left
            known["overwrite"] = True
        request: Request = self.operation.request.model_validate(
            {**known, **self.request_paths(task, options)}
        )
        return request

    @contextmanager
    def progress_callback(self, task: Task) -> Iterator[EventListener]:
        """Yield what hears the events of the operation."""
        yield stop_when_asked(task.progress, task.should_stop)

    def result_name(self, path: Path) -> str:
        """Return the name among the results of a file, by its path in the folder of the result."""
        return path.as_posix()

    def request_paths(self, task: Task, options: Any) -> dict[str, Any]:
        """Return where a job reads and writes, by the names of the request."""
        places = {"source": task.source, "output": task.results / self._output}
        if task.scene is not None and "dataset" in self.operation.request.model_fields:
            places["dataset"] = task.scene
        # where an import reads is an option of its own
        own = self.operation.request.model_fields.keys() - self.user_options.model_fields.keys()
        return {name: place for name, place in places.items() if name in own}
