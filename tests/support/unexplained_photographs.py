"""Photographs that materials do not explain, as the trials are to say; workers under test import it."""

from contextlib import ExitStack
from unittest.mock import patch

from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.task import Task


def patched_trials() -> ExitStack:
    """Let materials lose accuracy by either recipe, also before short trainings; as a context."""
    from octasplat.engine.pipeline import material_choice

    stack = ExitStack()
    stack.enter_context(patch.object(material_choice, "material_gain_db", lambda *_of, **_named: -1.0))
    stack.enter_context(patch.object(material_choice, "LONG_TRAINING_TRIALS", 0))
    return stack


def reconstruct(task: Task) -> None:
    from octasplat.workers.worker import reconstruct_handler

    with patched_trials():
        reconstruct_handler.reconstruct(task)


get_job_kind("reconstruct").program = f"{__name__}:reconstruct"
