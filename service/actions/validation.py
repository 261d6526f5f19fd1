"""Validation of a requested job kind and its options, before any database access."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.service.problems import ProblemError, options_error
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.worker.job_kinds import JobKind, get_job_kind
from octasplat.workers.worker.job_kinds.stored_options import requested_options, resolve_requested


def validate_kind(name: str) -> JobKind:
    """Return the kind of that name.

    Raises:
        ProblemError: 422.
    """
    try:
        return get_job_kind(name, is_asked_for=True)
    except ConfigError as error:
        raise ProblemError(
            422, "kind", str(error), errors=[{"pointer": "#/kind", "detail": str(error)}]
        ) from None


@dataclass(frozen=True)
class ResolvedOptions:
    """Options of a job, validated.

    Attributes:
        complete: every option, as this version completes what was asked for.
        requested: what was asked for; see :attr:`octasplat.workers.db.rows.Job.requested`.
    """

    complete: BaseModel
    requested: Mapping[str, Any] | None


async def resolve_options(kind: JobKind, values: Mapping[str, Any]) -> ResolvedOptions:
    """Return the options of a new job, validated in a thread, so that large ones delay no other request.

    Args:
        kind: the kind of the job.
        values: what was asked for.

    Raises:
        ProblemError: 422.
    """
    return await run_in_pool(ThreadPurpose.OPTIONS, _resolve, kind, values)


async def revise_options(
    kind: JobKind, before: ResolvedOptions, changes: Mapping[str, Any], *, is_resumed: bool
) -> ResolvedOptions:
    """Return the options of a job that is tried again with changes, validated in a thread.

    Args:
        kind: the kind of the job.
        before: its options.
        changes: what was asked for now.
        is_resumed: whether the job goes on with what it has done, under every setting that is not changed.

    Raises:
        ProblemError: 422.
    """
    return await run_in_pool(ThreadPurpose.OPTIONS, _revise, kind, before, changes, is_resumed)


def _resolve(kind: JobKind, values: Mapping[str, Any]) -> ResolvedOptions:
    try:
        complete = resolve_requested(kind, values)
        return ResolvedOptions(complete, requested_options(kind, values, complete))
    except (ValidationError, InvalidSettingsError) as error:
        raise options_error(error, kind.user_options.model_fields) from None


def _revise(
    kind: JobKind, before: ResolvedOptions, changes: Mapping[str, Any], is_resumed: bool
) -> ResolvedOptions:
    try:
        revised: BaseModel = kind.revise(before.complete.model_dump(mode="json"), changes)
        if before.requested is None:
            return ResolvedOptions(revised, None)
        requested = kind.revise_requested(before.requested, kind.as_requested(changes))
        # A job that begins anew gets the presets and defaults of this version.
        return ResolvedOptions(revised if is_resumed else resolve_requested(kind, requested), requested)
    except (ValidationError, InvalidSettingsError) as error:
        raise options_error(error, kind.user_options.model_fields) from None


def input_problem(name: str, detail: str) -> ProblemError:
    """Return the problem of inputs that are missing or do not fit the kind."""
    return ProblemError(422, "input", detail, errors=[{"pointer": f"#/{name}", "detail": detail}])
