"""Check of whether this version can run a job; workers of several versions run during an upgrade.

A job that this version does not know is left to a newer worker, and no attempt is counted.
"""

import uuid
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from octasplat.engine.core import versions
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.workers.db.connections import Pool
from octasplat.workers.db.rows import Job
from octasplat.workers.db.workers import live_workers
from octasplat.workers.queue.jobs import get_job
from octasplat.workers.worker.checkpoint import Checkpoint
from octasplat.workers.worker.job_kinds import get_job_kind, job_kinds
from octasplat.workers.worker.job_kinds.stored_options import resolve_here


def version_facts() -> dict[str, Any]:
    """Return the version facts that a worker publishes, to be matched with jobs."""
    return {
        "kinds": [kind.name for kind in job_kinds(with_internal=True)],
        "results": versions.RESULTS_VERSION,
    }


async def reason_incapable(pool: Pool, job_id: uuid.UUID, stale_seconds: float) -> str | None:
    """Return in a few words why a job is left to workers of another version; None if it is not.

    Args:
        pool: connections.
        job_id: the job.
        stale_seconds: after how long a worker counts as gone.
    """
    async with pool.connection() as connection:
        job = await get_job(connection, job_id)
        if job is None:
            return None
        if (unknown := _unknown_to_version(job)) is not None:
            return unknown
        # What a block begins with is the checkpoint of the whole job.
        whole = job if job.root_id is None else await get_job(connection, job.root_id)
        checkpoint = None if whole is None else whole.checkpoint
        if checkpoint is None or Checkpoint.from_row(checkpoint).results == versions.RESULTS_VERSION:
            return None
        made_by = Checkpoint.from_row(checkpoint).results
        # Left to a worker of that version only while one is alive; without any, the job begins anew here.
        for row in await live_workers(connection, stale_seconds):
            if job.queue in row.queues and row.facts.get("results", 1) == made_by:
                return "another worker can go on from its checkpoint, which is of another version"
    return None


def _unknown_to_version(job: Job) -> str | None:
    """Return what this version does not know of a job, or None."""
    try:
        kind = get_job_kind(job.kind)
    except ConfigError:
        return f"the kind {job.kind} is unknown here"
    try:
        resolve_here(kind, job)
    except ValidationError as error:  # it was valid where it was accepted
        where: Sequence[object] = error.errors()[0]["loc"]
    except InvalidSettingsError as error:
        where = error.refusals[0].path
    else:
        return None
    return f"the option {'.'.join(str(part) for part in where)} means nothing here"
