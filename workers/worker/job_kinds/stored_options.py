"""Options of jobs as the table keeps them, so that other versions may run the job.

They are kept as they were asked for, and each worker completes them with its own presets and defaults, and
says so in the row of the job. Beside them stand the options as the front end completed them, without what is
default: workers of the last version run these, where a setting that they do not know is missing unless
somebody has asked for it.
"""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from octasplat.workers.db.postgres_text import storable
from octasplat.workers.db.rows import Job
from octasplat.workers.worker.job_kinds.registry import JobKind


def without_defaults(options: BaseModel) -> dict[str, Any]:
    """Return options as JSON values without those that are default."""
    complete = options.model_dump(mode="json")
    model = type(options)
    # Not validated, as fields without a default are missing.
    defaults = model.model_construct().model_dump(mode="json", warnings=False)
    left = _differences(complete, defaults)
    # Where a preset decides on other options, the rest alone may mean something else.
    try:
        is_same = model.model_validate(left).model_dump(mode="json") == complete
    except ValidationError:
        is_same = False
    return left if is_same else complete


def resolve_requested(kind: JobKind, values: Mapping[str, Any]) -> BaseModel:
    """Return the complete options that the given ones mean to this version.

    Raises:
        ValidationError: an option cannot be used.
        InvalidSettingsError: likewise.
    """
    # By way of JSON values, as those of the row are read.
    resolved: BaseModel = kind.options.model_validate(kind.resolve(values).model_dump(mode="json"))
    return resolved


def requested_options(kind: JobKind, values: Mapping[str, Any], complete: BaseModel) -> dict[str, Any] | None:
    """Return what was asked for as it is kept; None where that does not mean the given complete options."""
    requested = storable(kind.as_requested(values))
    return requested if resolve_requested(kind, requested) == complete else None


def with_decisions(
    kind: JobKind, requested: Mapping[str, Any] | None, before: BaseModel, after: BaseModel
) -> dict[str, Any] | None:
    """Return what was asked for with what the inputs of the job have decided.

    Args:
        kind: of the job.
        requested: see :func:`requested_options`.
        before: the complete options that it means.
        after: the complete options for the inputs.
    """
    if requested is None or before == after:
        return None if requested is None else dict(requested)
    old, new = before.model_dump(mode="json"), after.model_dump(mode="json")
    return kind.revise_requested(requested, {name: new[name] for name in new if new[name] != old[name]})


def resolve_here(kind: JobKind, job: Job) -> BaseModel:
    """Return the complete options with which this version runs a job.

    Raises:
        ValidationError: they are of another version.
        InvalidSettingsError: likewise.
    """
    begun_with = _options_begun_with(kind, job)
    if begun_with is None and job.requested is not None:
        return resolve_requested(kind, job.requested)
    return begun_with or kind.options.model_validate(job.options)


def expected_options(kind: JobKind, job: Job) -> BaseModel:
    """Return the complete options of a job as they are to be expected where it runs.

    A job that goes on from a checkpoint keeps those that it was begun with, where this version can read them.

    Raises:
        ValidationError: they are of another version.
    """
    return _options_begun_with(kind, job) or kind.options.model_validate(job.options)


def _options_begun_with(kind: JobKind, job: Job) -> BaseModel | None:
    """Return the options of a job that goes on; None for another, or where this version cannot read them."""
    if job.settings is None or job.checkpoint is None:
        return None
    try:
        begun_with: BaseModel = kind.options.model_validate(job.settings)
    except ValidationError:
        return None
    return begun_with


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
