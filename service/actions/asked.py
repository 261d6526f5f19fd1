"""What is asked for: the kind of a job and its options, checked before anything is looked up."""

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from octasplat.engine.errors import ConfigError
from octasplat.engine.refusals import SettingsRefused
from octasplat.service.problems import Problem, refused_options
from octasplat.workers.work.kinds import JobKind, kind_named


def accepted_kind(name: str) -> JobKind:
    """The kind of that name.

    Raises:
        Problem: 422.
    """
    try:
        return kind_named(name)
    except ConfigError as error:
        raise Problem(422, "kind", str(error), errors=[{"pointer": "#/kind", "detail": str(error)}]) from None


def resolved(kind: JobKind, asked: Mapping[str, Any]) -> BaseModel:
    """Complete options.

    Raises:
        Problem: 422.
    """
    try:
        return kind.options.model_validate(kind.resolve(asked).model_dump(mode="json"))
    except (ValidationError, SettingsRefused) as error:
        raise refused_options(error) from None


def input_problem(name: str, detail: str) -> Problem:
    """What a job is to work on is not there, or does not fit its kind."""
    return Problem(422, "input", detail, errors=[{"pointer": f"#/{name}", "detail": detail}])
