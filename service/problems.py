"""Errors as problem documents (RFC 9457)."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from http import HTTPStatus
from typing import Any

import psycopg
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from psycopg_pool import PoolTimeout
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from starlette.exceptions import HTTPException
from starlette.routing import Match

from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.operations.base import error_text
from octasplat.engine.pathtracing.stage.stage_errors import stage_error
from octasplat.engine.settings.nearest_names import nearest_name
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.service.intake.faults import IntakeError
from octasplat.service.request_id import current_request_id
from octasplat.workers.db.errors import ConflictError, NotFoundError
from octasplat.workers.db.quotas import QuotaExceededError
from octasplat.workers.storage.errors import (
    BlobNotFoundError,
    ContentTooLargeError,
    DigestMismatchError,
    StorageError,
    StorageFullError,
    StorageUnavailableError,
)
from octasplat.workers.worker.path_redaction import shorten_absolute_paths

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:octasplat:problem:"
RETRY_SECONDS = 5
MAX_ERRORS = 50
"""Most single faults that an answer lists."""

logger = logging.getLogger(__name__)


class ProblemDocument(BaseModel):
    """A problem document (RFC 9457)."""

    model_config = ConfigDict(
        extra="allow",
        json_schema_extra={
            "examples": [
                {
                    "type": "urn:octasplat:problem:not-found",
                    "title": "Not Found",
                    "status": 404,
                    "detail": "There is no such job.",
                }
            ]
        },
    )

    type: str
    title: str
    status: int
    detail: str
    request_id: str | None = Field(None, description="Of X-Request-ID; lines of the service's log name it.")
    errors: list[dict[str, Any]] | None = None


class ProblemError(Exception):
    """An error that is answered with a problem document.

    Args:
        status: HTTP status.
        code: stable name, the end of the document's ``type``.
        detail: one sentence for the user.
        errors: single faults, each with a JSON pointer.
        headers: of the answer.
        retry_seconds: when to try again, told in ``Retry-After``.
    """

    def __init__(
        self,
        status: int,
        code: str,
        detail: str,
        *,
        errors: Sequence[Mapping[str, Any]] | None = None,
        headers: Mapping[str, str] | None = None,
        retry_seconds: int | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.code = code
        self.detail = detail
        self.errors = errors
        self.headers = dict(headers or {})
        if retry_seconds is not None:
            self.headers["Retry-After"] = str(retry_seconds)

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "ProblemError":
        """Return the problem of a document of :meth:`document`."""
        code = str(document["type"]).removeprefix(TYPE_PREFIX)
        status = int(document["status"])
        again = RETRY_SECONDS if status in (429, 503, 507) else None
        return cls(status, code, document["detail"], errors=document.get("errors"), retry_seconds=again)

    def document(self) -> dict[str, Any]:
        """Return the problem document (RFC 9457), without the id of a request."""
        content: dict[str, Any] = {
            "type": TYPE_PREFIX + self.code,
            "title": HTTPStatus(self.status).phrase,
            "status": self.status,
            "detail": self.detail,
        }
        if self.errors is not None:
            content["errors"] = [dict(error) for error in self.errors]
        return content

    def response(self) -> JSONResponse:
        """Return the problem as a JSON response."""
        content = self.document()
        if (request_id := current_request_id()) is not None:
            content["request_id"] = request_id
        return JSONResponse(content, status_code=self.status, headers=self.headers, media_type=MEDIA_TYPE)


def not_found_error(kind: str) -> ProblemError:
    """Return the problem of an object that does not exist or is another owner's, without saying which."""
    return ProblemError(404, "not-found", f"There is no such {kind}.")


def options_error(
    error: ValidationError | InvalidSettingsError, known: Iterable[str] = (), prefix: str = "/options"
) -> ProblemError:
    """Return the problem of options that do not fit their schema.

    Args:
        error: what was refused.
        known: names of the options, of which the one nearest to an unknown one is offered.
        prefix: JSON pointer to the options in the request.
    """
    if isinstance(error, InvalidSettingsError):
        faults = [
            {"code": each.code, "detail": each.sentence, "pointer": _pointer(prefix, each.path)}
            for each in error.refusals[:MAX_ERRORS]
        ]
        return ProblemError(422, "options", str(error) + _unlisted(len(error.refusals)), errors=faults)
    return ProblemError(
        422,
        "options",
        f"{error.error_count()} of the options cannot be used; see errors, and GET /v1/options."
        + _unlisted(error.error_count()),
        errors=_distinct(
            _field_error(prefix, _with_nearest(fault, known))
            for fault in error.errors(include_url=False)[:MAX_ERRORS]
        ),
    )


def add_problem_handlers(app: FastAPI) -> None:
    """Answer every error with a problem document."""
    app.add_exception_handler(ProblemError, _on_problem)
    app.add_exception_handler(OctasplatError, _on_octasplat_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(psycopg.DataError, _on_data_error)
    app.add_exception_handler(psycopg.IntegrityError, _on_integrity_error)
    for kind in (psycopg.OperationalError, PoolTimeout):
        app.add_exception_handler(kind, _on_database_error)
    app.add_exception_handler(Exception, _on_exception)


def problem_from_error(error: OctasplatError) -> ProblemError:
    """Return the problem document of an error of ours."""
    detail, again = str(error), RETRY_SECONDS
    if isinstance(error, IntakeError):
        status = 408 if error.code in ("upload-stalled", "upload-too-slow") else 422
        detail += _unlisted(len(error.faults))
        faults = [fault.as_dict() for fault in error.faults[:MAX_ERRORS]]
        return ProblemError(status, error.code, detail, errors=faults)
    if isinstance(error, QuotaExceededError):
        # Bytes come back by deleting only, the others also by waiting.
        status = 413 if error.resource == "bytes" else 429
        return ProblemError(
            status,
            f"quota-{error.resource}",
            detail,
            headers={"RateLimit": f'"{error.resource}";r=0'},
            retry_seconds=again if status == 429 else None,
        )
    if isinstance(error, NotFoundError):
        return not_found_error(error.kind)
    if isinstance(error, ConflictError):
        return ProblemError(409, "conflict", detail)
    # Single kinds of StorageError, before all others below.
    if isinstance(error, StorageFullError):
        return ProblemError(507, "storage-full", shorten_absolute_paths(detail), retry_seconds=again)
    if isinstance(error, ContentTooLargeError):
        return ProblemError(413, "too-large", detail)
    if isinstance(error, DigestMismatchError):
        return ProblemError(422, "digest-mismatch", detail)
    if isinstance(error, BlobNotFoundError):
        return ProblemError(410, "content-gone", "The content is not in the store any more.")
    if isinstance(error, StorageUnavailableError | StorageError):
        logger.warning("the store: %s", error)
        return ProblemError(
            503, "storage", "The store does not answer; try again later.", retry_seconds=again
        )
    return ProblemError(422, "refused", shorten_absolute_paths(detail))


def unexpected_problem() -> ProblemError:
    """Return the problem of an error that nobody expected, of which the log says more."""
    return ProblemError(500, "unexpected", "Something went wrong here; the service's log says what.")


async def _on_problem(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, ProblemError)
    return error.response()


async def _on_octasplat_error(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, OctasplatError)
    return problem_from_error(error).response()


async def _on_validation_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    found = [_body_fault(request, fault) for fault in error.errors()]
    detail = "The request does not have the form that is asked for; see errors." + _unlisted(len(found))
    faults = [_field_error("", fault) for fault in found[:MAX_ERRORS]]
    return ProblemError(422, "request", detail, errors=faults).response()


def _body_fault(request: Request, fault: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a fault of a request, in words of HTTP where the body as a whole could not be read."""
    if fault["type"] == "json_invalid":  # its place is a position in the text, which no pointer can name
        reason = f"{fault.get('ctx', {}).get('error', 'it breaks off')} at character {fault['loc'][-1]}"
        return {**fault, "loc": ("body",), "msg": f"The body is no JSON: {reason}"}
    is_json = "json" in request.headers.get("Content-Type", "")
    if fault["loc"] == ("body",) and isinstance(fault.get("input"), bytes | str) and not is_json:
        message = "The body is read as JSON only with the header Content-Type: application/json"
        return {**fault, "type": "content_type", "msg": message}
    return fault


async def _on_http_exception(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    detail = {
        404: "There is nothing at this address.",
        405: "This address does not take that method.",
        413: "The request is too long.",
    }.get(error.status_code, str(error.detail))
    code = HTTPStatus(error.status_code).phrase.lower().replace(" ", "-")
    headers = dict(error.headers or {})
    if error.status_code == 405:
        headers["Allow"] = ", ".join(_methods_of_address(request))
    return ProblemError(error.status_code, code, detail, headers=headers).response()


def _methods_of_address(request: Request) -> list[str]:
    """Return all methods that an address takes, of which each has a route of its own."""
    found: set[str] = set()
    waiting = list(request.app.routes)
    while waiting:
        route = waiting.pop()
        inner = getattr(route, "original_router", None)
        if inner is not None:  # a router that was included, with its routes
            waiting += inner.routes
        elif route.matches(request.scope)[0] is not Match.NONE:
            found.update(getattr(route, "methods", None) or ())
    return sorted(found)


async def _on_database_error(_request: Request, error: Exception) -> JSONResponse:
    logger.warning("the database: %s", " ".join(str(error).split()))
    return ProblemError(
        503,
        "database",
        "The database does not answer; try again in a moment.",
        retry_seconds=RETRY_SECONDS,
    ).response()


async def _on_data_error(_request: Request, error: Exception) -> JSONResponse:
    logger.warning("the database took a value for impossible: %s", " ".join(str(error).split()))
    detail = "The request holds a value that cannot be stored, such as a NUL character or too large a number."
    return ProblemError(422, "request", detail).response()


async def _on_integrity_error(_request: Request, error: Exception) -> JSONResponse:
    """Return the problem of two concurrent requests of which the other came first."""
    logger.info("the database refused what contradicts it: %s", " ".join(str(error).split()))
    detail = "Something that this builds on was changed or deleted at the same time; look again."
    return ProblemError(409, "conflict", detail).response()


async def _on_exception(request: Request, error: Exception) -> JSONResponse:
    logger.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return unexpected_problem().response()


def _unlisted(count: int) -> str:
    """Return how many of so many faults an answer leaves out, as a sentence after another; empty for none."""
    return f" {count - MAX_ERRORS} more are not listed." if count > MAX_ERRORS else ""


def _distinct(faults: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return faults without those of which an earlier one says the same, as of the parts of a union."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for fault in faults:
        found.setdefault((fault["detail"], str(fault.get("pointer"))), fault)
    return list(found.values())


def _with_nearest(fault: Mapping[str, Any], known: Iterable[str]) -> Mapping[str, Any]:
    """Return a fault, in which an unknown option is answered with the nearest one."""
    if fault["type"] != "extra_forbidden" or len(fault["loc"]) != 1:
        return fault
    nearest = nearest_name(str(fault["loc"][0]), known)
    more = f"; the nearest is {nearest}" if nearest else ""
    return {**fault, "msg": f"There is no such option{more}"}


def _field_error(prefix: str, fault: Mapping[str, Any]) -> dict[str, Any]:
    is_unknown = fault["type"] == "extra_forbidden" and len(fault["loc"]) == 1  # of a kind without stages
    if fault["loc"][:1] == ("stage",) and not is_unknown:  # told as whoever reads a stage file would be told
        keys, message = stage_error({**fault, "loc": fault["loc"][1:]}, ("stage",))
        fault = {**fault, "loc": keys, "msg": message}
    where, *path = fault["loc"] or ("",)
    if fault["type"] == "extra_forbidden" and not prefix and path:
        fault = {**fault, "msg": f"There is no field '{path[-1]}' here"}
    if prefix:
        path = [where, *path]
        where = "body"
    named = (
        {"pointer": _pointer(prefix, path)}
        if where == "body"
        else {"parameter": "/".join(str(p) for p in path)}
    )
    return {"code": str(fault["type"]), "detail": error_text(str(fault["msg"])), **named}


def _pointer(prefix: str, path: Iterable[str | int]) -> str:
    """Return a JSON pointer into the request."""
    escaped = (str(part).replace("~", "~0").replace("/", "~1") for part in path)
    return f"#{prefix}" + "".join(f"/{part}" for part in escaped)
