"""Options of jobs as the table keeps them: without what is default, so that other versions may run the job.

A version that knows one more option leaves it out unless somebody has asked for it. Each worker completes the
options with its own defaults, and says so in the row of the job.
"""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from octasplat.workers.db.rows import Job
from octasplat.workers.worker.job_kinds.registry import JobKind


def without_defaults(options: BaseModel) -> dict[str, Any]:
    """Return options as JSON values without those that are default."""
    complete = options.model_dump(mode="json")
    model = type(options)
    defaults = model.model_construct().model_dump(mode="json", warnings=False)
    left = _differences(complete, defaults)
    try:
        is_same = model.model_validate(left).model_dump(mode="json") == complete
    except ValidationError:
        is_same = False
    return left if is_same else complete


def options_of(kind: JobKind, job: Job) -> BaseModel:
    """Return the complete options of a job.

    A job that goes on from a checkpoint keeps those that it was begun with, where this version can read them.

    Raises:
        ValidationError: they are of another version.
    """
    if job.settings is not None and job.checkpoint is not None:
        try:
            return kind.options.model_validate(job.settings)
        except ValidationError:
            pass
    return kind.options.model_validate(job.options)


def _differences(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of nested values is not in the defaults."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if name not in defaults:
            found[name] = value
        elif isinstance(value, dict) and isinstance(defaults[name], dict):
            inner = _differences(value, defaults[name])
            if inner or value.keys() != defaults[name].keys():
                found[name] = inner
        elif value != defaults[name]:
            found[name] = value
    return found
