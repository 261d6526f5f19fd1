"""The toy of a later version: it has one more option, and a sibling."""

from dataclasses import replace

import toy_kind
from toy_kind import ToyOptions

from octasplat.workers.work.kinds import register
from octasplat.workers.work.kinds.table import _KINDS, validated
from octasplat.workers.work.task import Task


class LaterOptions(ToyOptions):
    shade: float = 0.0


def run(task: Task) -> None:
    known = {name: value for name, value in task.options.items() if name in ToyOptions.model_fields}
    toy_kind.run(replace(task, options=known))


TOY = _KINDS.pop("toy")
for name in ("toy", "later"):
    register(
        replace(
            TOY, name=name, options=LaterOptions, program="later_toy:run", resolve=validated(LaterOptions)
        )
    )
