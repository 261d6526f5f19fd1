"""The toy of a later version: it has one more option, and a sibling."""

from dataclasses import replace

from octasplat.workers.worker.job_kinds import JobKind, register
from octasplat.workers.worker.job_kinds.registry import _KINDS
from octasplat.workers.worker.task import Task
from tests.support import toy_kind
from tests.support.toy_kind import ToyOptions


class LaterOptions(ToyOptions):
    shade: float = 0.0


def run(task: Task) -> None:
    known = {name: value for name, value in task.options.items() if name in ToyOptions.model_fields}
    toy_kind.run(replace(task, options=known))


_KINDS.pop("toy")
for name in ("toy", "later"):
    register(
        JobKind(
            name=name,
            title="Counts",
            needs="dataset",
            options=LaterOptions,
            program="tests.support.next_version_toy:run",
            stages=("train",),
        )
    )
