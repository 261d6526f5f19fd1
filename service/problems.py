"""Errors as problem documents (RFC 9457), and nothing but those."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from http import HTTPStatus
from typing import Any

import psycopg
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from psycopg_pool import PoolTimeout
from pydantic import BaseModel, ConfigDict, ValidationError
from starlette.exceptions import HTTPException

from octasplat.engine.errors import OctasplatError
from octasplat.engine.light.stage_file import stage_complaint, stage_keys
from octasplat.engine.operations.base import complaint
from octasplat.engine.refusals import SettingsRefused
from octasplat.service.intake.faults import IntakeRefused
from octasplat.workers.records.errors import Conflict, Missing
from octasplat.workers.records.quotas import QuotaExceeded
from octasplat.workers.store.errors import (
    BlobMissing,
    DigestMismatch,
    StorageError,
    StorageFull,
    StorageUnavailable,
    TooLarge,
)
from octasplat.workers.work.places import without_paths

MEDIA_TYPE = "application/problem+json"
TYPES = "urn:octasplat:problem:"
RETRY_SECONDS = 5

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
    errors: list[dict[str, Any]] | None = None


class Problem(Exception):
    """Something to be answered with a problem document.

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

    def response(self) -> JSONResponse:
        """The answer."""
        content: dict[str, Any] = {
            "type": TYPES + self.code,
            "title": HTTPStatus(self.status).phrase,
            "status": self.status,
            "detail": self.detail,
        }
        if self.errors is not None:
            content["errors"] = [dict(error) for error in self.errors]
        return JSONResponse(content, status_code=self.status, headers=self.headers, media_type=MEDIA_TYPE)


def not_found(what: str) -> Problem:
    """There is none, or it is somebody else's; which of the two is not told."""
    return Problem(404, "not-found", f"There is no such {what}.")


def refused_options(error: ValidationError | SettingsRefused, prefix: str = "/options") -> Problem:
    """Options that do not fit their schema."""
    if isinstance(error, SettingsRefused):
        faults = [
            {"code": each.code, "detail": each.sentence, "pointer": _pointer(prefix, each.path)}
            for each in error.refusals
        ]
        return Problem(422, "options", str(error), errors=faults)
    return Problem(
        422,
        "options",
        f"{len(error.errors())} of the options cannot be used; see errors, and GET /v1/options.",
        errors=[_fault(prefix, fault) for fault in error.errors(include_url=False)],
    )


def add_problem_handlers(app: FastAPI) -> None:
    """Answer every error with a problem document."""
    app.add_exception_handler(Problem, _on_problem)
    app.add_exception_handler(OctasplatError, _on_octasplat_error)
    app.add_exception_handler(RequestValidationError, _on_validation_error)
    app.add_exception_handler(HTTPException, _on_http_exception)
    app.add_exception_handler(psycopg.DataError, _on_data_error)
    app.add_exception_handler(psycopg.IntegrityError, _on_integrity_error)
    for kind in (psycopg.OperationalError, PoolTimeout):
        app.add_exception_handler(kind, _on_database_error)
    app.add_exception_handler(Exception, _on_exception)


def problem_of(error: OctasplatError) -> Problem:
    """How an error of ours is answered."""
    detail, again = str(error), RETRY_SECONDS
    if isinstance(error, IntakeRefused):
        status = 408 if error.code == "upload-stalled" else 422
        return Problem(status, error.code, detail, errors=[fault.as_dict() for fault in error.faults])
    if isinstance(error, QuotaExceeded):
        # Bytes come back by deleting only, the others also by waiting.
        status = 413 if error.of == "bytes" else 429
        return Problem(status, f"quota-{error.of}", detail, retry_seconds=again if status == 429 else None)
    if isinstance(error, Missing):
        return not_found(error.what)
    if isinstance(error, Conflict):
        return Problem(409, "conflict", detail)
    if isinstance(error, StorageFull):
        return Problem(507, "storage-full", without_paths(detail), retry_seconds=again)
    if isinstance(error, TooLarge):
        return Problem(413, "too-large", detail)
    if isinstance(error, DigestMismatch):
        return Problem(422, "digest-mismatch", detail)
    if isinstance(error, BlobMissing):
        return Problem(410, "content-gone", "The content is not in the store any more.")
    if isinstance(error, StorageUnavailable | StorageError):
        logger.warning("the store: %s", error)
        return Problem(503, "storage", "The store does not answer; try again later.", retry_seconds=again)
    return Problem(422, "refused", without_paths(detail))


async def _on_problem(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, Problem)
    return error.response()


async def _on_octasplat_error(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, OctasplatError)
    return problem_of(error).response()


async def _on_validation_error(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    faults = [_fault("", fault) for fault in error.errors()]
    return Problem(
        422, "request", "The request does not have the form that is asked for; see errors.", errors=faults
    ).response()


async def _on_http_exception(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    detail = {
        404: "There is nothing at this address.",
        405: "This address does not take that method.",
        413: "The request is too long.",
    }.get(error.status_code, str(error.detail))
    code = HTTPStatus(error.status_code).phrase.lower().replace(" ", "-")
    return Problem(error.status_code, code, detail, headers=error.headers).response()


async def _on_database_error(_request: Request, error: Exception) -> JSONResponse:
    logger.warning("the database: %s", " ".join(str(error).split()))
    return Problem(
        503,
        "database",
        "The database does not answer; try again in a moment.",
        retry_seconds=RETRY_SECONDS,
    ).response()


async def _on_data_error(_request: Request, error: Exception) -> JSONResponse:
    logger.warning("the database took a value for impossible: %s", " ".join(str(error).split()))
    detail = "The request holds a value that cannot be stored, such as a NUL character or too large a number."
    return Problem(422, "request", detail).response()


async def _on_integrity_error(_request: Request, error: Exception) -> JSONResponse:
    """Two requests at once, of which the other came first."""
    logger.info("the database refused what contradicts it: %s", " ".join(str(error).split()))
    detail = "Something that this builds on was changed or deleted at the same time; look again."
    return Problem(409, "conflict", detail).response()


async def _on_exception(request: Request, error: Exception) -> JSONResponse:
    logger.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return Problem(500, "unexpected", "Something went wrong here; the service's log says what.").response()


def _fault(prefix: str, fault: Mapping[str, Any]) -> dict[str, Any]:
    if fault["loc"][:1] == ("stage",):  # told as whoever reads a stage file would be told
        keys = ("stage", *stage_keys(fault["loc"][1:]))
        told = stage_complaint(fault["type"], keys, fault["msg"], fault.get("input"))
        fault = {**fault, "loc": keys, "msg": told}
    where, *path = fault["loc"] or ("",)
    if prefix:
        path = [where, *path]
        where = "body"
    named = (
        {"pointer": _pointer(prefix, path)}
        if where == "body"
        else {"parameter": "/".join(str(p) for p in path)}
    )
    return {"code": str(fault["type"]), "detail": complaint(str(fault["msg"])), **named}


def _pointer(prefix: str, path: Iterable[str | int]) -> str:
    """A JSON pointer into the request."""
    escaped = (str(part).replace("~", "~0").replace("/", "~1") for part in path)
    return f"#{prefix}" + "".join(f"/{part}" for part in escaped)
