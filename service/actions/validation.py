"""Validation of a requested job kind and its options, before any database access."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.service.problems import ProblemError, options_error
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


def resolve_options(kind: JobKind, values: Mapping[str, Any]) -> BaseModel:
    """Return the complete options.

    Raises:
        ProblemError: 422.
    """
    try:
        return kind.options.model_validate(kind.resolve(values).model_dump(mode="json"))
    except (ValidationError, InvalidSettingsError) as error:
        raise options_error(error) from None


def input_problem(name: str, detail: str) -> ProblemError:
    """Return the problem of inputs that are missing or do not fit the kind."""
    return ProblemError(422, "input", detail, errors=[{"pointer": f"#/{name}", "detail": detail}])
