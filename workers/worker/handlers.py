"""Program of the jobs that run an operation; only a job's own process imports this.

The operation imports what it needs when it runs.
"""

from contextlib import nullcontext

from octasplat.engine.core.events import Noted
from octasplat.engine.core.progress import counted_phase
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.operation_kind import OperationKind
from octasplat.workers.worker.publishing import path_redactor, publish_file
from octasplat.workers.worker.stored_frames import write_moved_results
from octasplat.workers.worker.task import Task


def run_operation(task: Task) -> None:
    """Run the operation of the job's kind and publish its files."""
    kind = get_job_kind(task.kind)
    assert isinstance(kind, OperationKind)
    options = kind.resolve(task.options)
    with kind.progress_callback(task) as report:
        phase_context = (
            nullcontext() if kind.reports_stages else counted_phase(kind.stages(options)[0], report, 0)
        )
        with phase_context:
            result = kind.operation.execute(
                kind.build_request(task), progress=report, should_stop=task.should_stop, threads=task.threads
            )
    moved: dict[str, str] = {}
    for path in result.files:
        if not path.is_relative_to(task.results):
            name = kind.result_name(path.relative_to(result.folder or task.run))
            try:
                publish_file(task, path, name)
            except FileNotFoundError:  # stored and removed already
                moved[name] = path.relative_to(task.folder).as_posix()
    if moved:
        write_moved_results(task.folder, moved)
    for line in result.lines():
        task.progress(Noted(path_redactor(task).replace_job_paths(line)))
