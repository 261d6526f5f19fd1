"""What came of attempts that a confined program makes."""

import json
from collections.abc import Callable, Mapping

from octasplat.workers.worker.task import Task


def write_outcomes(task: Task, attempts: Mapping[str, Callable[[], object]]) -> None:
    """Write ``found.json``: what each attempt gave, its value or the type of its error."""
    found: dict[str, object] = {}
    for name, attempt in attempts.items():
        try:
            found[name] = attempt()
        except OSError as error:
            found[name] = type(error).__name__
    (task.results / "found.json").write_text(json.dumps(found, default=str))
