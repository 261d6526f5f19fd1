"""The job that a new one begins with: whether it has anything to begin with."""

import uuid

from pydantic import BaseModel

from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.service.actions.validation import input_problem
from octasplat.service.auth import Principal
from octasplat.service.problems import ProblemError, options_error
from octasplat.service.state import Service
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.jobs import artifacts_of, get_job
from octasplat.workers.worker.job_kinds import JobKind
from octasplat.workers.worker.start_files import START_RECORD, start_choices


async def may_be_begun_with(service: Service, kind: JobKind, source: Job) -> bool:
    """Return :func:`is_start` on a connection of its own."""
    async with service.pool.connection() as connection:
        return await is_start(connection, kind, source)


async def is_start(connection: Connection, kind: JobKind, source: Job) -> bool:
    """Return whether a job of a kind may begin with what another has come to."""
    is_possible = kind.may_start_from_result and source.kind == kind.name and source.is_over
    return is_possible and bool(start_choices(source, await artifacts_of(connection, source.id)))


async def fetch_start_source(
    connection: Connection, principal: Principal, kind: JobKind, source_id: uuid.UUID
) -> Job:
    """Return the job that a new one of a kind begins with, locked, so that it is not deleted before.

    Raises:
        ProblemError: 422 if there is none, or of another kind; 409 if it is not over, or has nothing.
    """
    source = await get_job(connection, source_id, lock=True)
    if source is None or not principal.may_see(source.owner):
        raise input_problem("source_id", "There is no such job.")
    if source.kind != kind.name:
        detail = (
            f"A job of the kind {kind.name} begins with one of its own kind; source_id is a {source.kind}."
        )
        raise input_problem("source_id", detail)
    if not source.is_over:
        detail = f"The job in source_id is {source.state}; wait until it is over, or cancel it."
        raise ProblemError(409, "source", detail)
    if not await is_start(connection, kind, source):
        detail = f"The job in source_id is {source.state} and has neither a scene nor a checkpoint."
        raise ProblemError(409, "source", detail)
    return source


def options_with_start(kind: JobKind, options: BaseModel) -> BaseModel:
    """Return the options of a job that begins with another one, as they are kept.

    Raises:
        ProblemError: 422, with these options it cannot.
    """
    try:
        begun: BaseModel = kind.with_start(options)
    except InvalidSettingsError as error:
        raise options_error(error) from None
    return begun


def lacks_source(kind: JobKind, options: BaseModel, job: Job, *, is_resumed: bool) -> bool:
    """Return whether a job cannot be tried again, as it needs its source job, which was deleted.

    One that goes on from a checkpoint has its own copy of what it begins with there.
    """
    if job.source_id is not None:
        return False
    files = job.checkpoint["files"] if job.checkpoint is not None and is_resumed else ()
    has_copy = any(file["path"] == START_RECORD for file in files)
    return kind.needs == "result" or (kind.starts_from_result(options) and not has_copy)
