"""Check that a request has no query parameters but those that its route declares."""

from collections.abc import Iterator
from typing import Any

from fastapi import Request
from fastapi.dependencies.models import Dependant

from octasplat.service.problems import MAX_ERRORS, ProblemError


def refuse_unknown_parameters(request: Request) -> None:
    """Refuse query parameters that the route of a request does not have; a dependency of all routes.

    Raises:
        ProblemError: 422, with the names.
    """
    if not request.query_params:
        return
    known = set(_declared_names(request.scope["route"].dependant))
    unknown = [name for name in dict.fromkeys(request.query_params) if name not in known]
    if not unknown:
        return
    errors: list[dict[str, Any]] = [
        {"code": "unknown_parameter", "detail": f"There is no query parameter {name!r}.", "parameter": name}
        for name in (name[:100] for name in unknown[:MAX_ERRORS])
    ]
    listed = f"known are {', '.join(sorted(known))}" if known else "it takes none"
    detail = f"The address does not take the query parameter {errors[0]['parameter']!r}; {listed}."
    raise ProblemError(422, "request", detail, errors=errors)


def _declared_names(dependant: Dependant) -> Iterator[str]:
    yield from (parameter.alias for parameter in dependant.query_params)
    for each in dependant.dependencies:
        yield from _declared_names(each)
