"""Validation of a requested job kind and its options, before any database access."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.service.problems import ProblemError, options_error
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.worker.job_kinds import JobKind, get_job_kind


def validate_kind(name: str) -> JobKind:
    """Return the kind of that name.

    Raises:
        ProblemError: 422.
    """
    try:
        return get_job_kind(name)
    except ConfigError as error:
        raise ProblemError(
            422, "kind", str(error), errors=[{"pointer": "#/kind", "detail": str(error)}]
        ) from None


async def resolve_options(
    kind: JobKind, values: Mapping[str, Any], *, before: Mapping[str, Any] | None = None
) -> BaseModel:
    """Return the complete options, validated in a thread, so that large ones delay no other request.

    Args:
        kind: the kind of the job.
        values: what was asked for.
        before: options of a job that they change; None for a new job.

    Raises:
        ProblemError: 422.
    """
    return await run_in_pool(ThreadPurpose.OPTIONS, _resolve, kind, values, before)


def _resolve(kind: JobKind, values: Mapping[str, Any], before: Mapping[str, Any] | None) -> BaseModel:
    try:
        if before is not None:
            return kind.revise(before, values)
        return kind.options.model_validate(kind.resolve(values).model_dump(mode="json"))
    except (ValidationError, InvalidSettingsError) as error:
        raise options_error(error) from None


def input_problem(name: str, detail: str) -> ProblemError:
    """Return the problem of inputs that are missing or do not fit the kind."""
    return ProblemError(422, "input", detail, errors=[{"pointer": f"#/{name}", "detail": detail}])
