"""Expiry of jobs and datasets, and deletion of those that have expired.

The time of expiry is in the row beforehand: ``expires_at`` is set once, when a job is over or a dataset is
not in use any more, and stays until the row is pinned, used or retried. All times are the database's.
"""

import logging
import uuid
from dataclasses import dataclass

from psycopg import sql

from octasplat.workers.db.audit import delete_old_entries
from octasplat.workers.db.connections import Connection, Pool
from octasplat.workers.db.dataset_checks import reopen_stale_checks
from octasplat.workers.db.dataset_tasks import delete_old_tasks
from octasplat.workers.db.datasets import get_dataset
from octasplat.workers.db.errors import ConflictError
from octasplat.workers.db.locks import about_to_lock_jobs, lock_owner
from octasplat.workers.db.sessions import delete_old_sessions
from octasplat.workers.db.uploads import delete_expired_uploads
from octasplat.workers.maintenance.webhooks.outbox import purge_deliveries
from octasplat.workers.queue.jobs import delete_job, get_job
from octasplat.workers.settings import Retention

logger = logging.getLogger(__name__)

MIN_NOTICE_HOURS = 24.0
"""What is old already when it comes under retention is kept so long from then on, if not shorter anyway."""
IDEMPOTENCY_KEY_DAYS = 7
MAX_PROGRESS_EVENTS = 1000
_BATCH_SIZE = 200


@dataclass(frozen=True)
class DeletedCounts:
    """Numbers of deleted jobs and datasets."""

    jobs: int
    datasets: int


async def apply_retention(pool: Pool, retention: Retention, audit_hours: float) -> None:
    """Delete what is older than it is to be kept, and open what a lost process has closed.

    Each step is a transaction of its own: rows that one has locked are not kept from others while the next
    one waits for the lock of an owner.

    Args:
        pool: connections.
        retention: how long jobs and datasets are kept.
        audit_hours: how long entries of the audit are kept.
    """
    async with pool.connection() as connection:
        if opened := await reopen_stale_checks(connection):
            logger.warning("%d datasets were closed by checks that were lost, and are open again", opened)
    async with pool.connection() as connection:
        await update_expiry_times(connection, retention)
    async with pool.connection() as connection:
        await delete_expired(connection)
    for forget in (
        purge_deliveries,
        delete_old_idempotency_keys,
        delete_old_sessions,
        delete_old_tasks,
        delete_expired_uploads,
    ):
        async with pool.connection() as connection:
            await forget(connection)
    async with pool.connection() as connection:
        await delete_old_entries(connection, audit_hours)


async def update_expiry_times(connection: Connection, retention: Retention) -> None:
    """Set the expiry times of rows that will expire, and clear those of rows that are kept after all."""
    async with connection.transaction():
        await connection.execute(
            """
            UPDATE jobs SET expires_at = NULL
            WHERE expires_at IS NOT NULL AND (pinned OR state NOT IN ('succeeded', 'failed', 'canceled'))
            """
        )
        kinds = dict(retention.jobs_hours_by_kind)
        await connection.execute(
            """
            UPDATE jobs SET expires_at = greatest(finished_at + make_interval(secs => 3600 * kept.hours),
                now() + make_interval(secs => 3600 * least(kept.hours, %(notice)s)))
            FROM (
                SELECT jobs.id, coalesce(special.hours, %(hours)s::float8) AS hours FROM jobs
                LEFT JOIN unnest(%(kinds)s::text[], %(kind_hours)s::float8[]) AS special (kind, hours)
                    ON special.kind = jobs.kind
                WHERE jobs.expires_at IS NULL AND NOT jobs.pinned AND jobs.root_id IS NULL
                  AND jobs.state IN ('succeeded', 'failed', 'canceled')
            ) AS kept
            WHERE kept.id = jobs.id AND kept.hours > 0
            """,
            {
                "hours": retention.jobs_hours,
                "notice": MIN_NOTICE_HOURS,
                "kinds": list(kinds),
                "kind_hours": list(kinds.values()),
            },
        )
        await connection.execute(
            """
            UPDATE datasets SET expires_at = NULL
            WHERE expires_at IS NOT NULL
              AND (pinned OR EXISTS (SELECT 1 FROM jobs WHERE datasets.id IN (jobs.dataset_id, jobs.files_id))
                   OR (SELECT max(uploaded_at) FROM dataset_files WHERE dataset_id = datasets.id)
                      + make_interval(secs => 3600 * %(open)s::float8) > expires_at AND state = 'open')
            """,
            {"open": retention.open_datasets_hours},
        )
        await connection.execute(
            """
            UPDATE datasets SET expires_at = greatest(kept.used_at + make_interval(secs => 3600 * kept.hours),
                now() + make_interval(secs => 3600 * least(kept.hours, %(notice)s)))
            FROM (
                SELECT d.id, CASE WHEN d.state = 'committed' THEN %(hours)s::float8 ELSE %(open)s::float8 END
                    AS hours,
                    greatest(d.used_at, (SELECT max(uploaded_at) FROM dataset_files WHERE dataset_id = d.id))
                    AS used_at
                FROM datasets d
                WHERE d.expires_at IS NULL AND NOT d.pinned
                  AND NOT EXISTS (SELECT 1 FROM jobs WHERE d.id IN (jobs.dataset_id, jobs.files_id))
            ) AS kept
            WHERE kept.id = datasets.id AND kept.hours > 0
            """,
            {
                "hours": retention.datasets_hours,
                "open": retention.open_datasets_hours,
                "notice": MIN_NOTICE_HOURS,
            },
        )


async def delete_expired(connection: Connection) -> DeletedCounts:
    """Delete what has expired; its contents stay in the store until they are collected."""
    # Jobs first, as a dataset stays for as long as there are jobs on it.
    jobs = [
        await _delete_expired_job(connection, job_id) for job_id in await _expired_ids(connection, "jobs")
    ]
    datasets = [
        await _delete_expired_dataset(connection, d) for d in await _expired_ids(connection, "datasets")
    ]
    return DeletedCounts(sum(jobs), sum(datasets))


async def delete_old_idempotency_keys(connection: Connection) -> None:
    """Delete idempotency keys that are too old to be repeated."""
    await connection.execute(
        "DELETE FROM idempotency_keys WHERE created_at < now() - make_interval(days => %s)",
        [IDEMPOTENCY_KEY_DAYS],
    )


async def thin_progress_events(connection: Connection, max_events: int = MAX_PROGRESS_EVENTS) -> int:
    """Thin out the progress events of long jobs; their curves keep their shape.

    Args:
        connection: to the database.
        max_events: a job with more than twice as many progress events keeps about so many, the first and
            the newest among them.

    Returns:
        Number of events that were forgotten.
    """
    cursor = await connection.execute(
        """
        WITH long AS (
            SELECT id FROM jobs
            WHERE (state IN ('running', 'canceling') OR finished_at > now() - interval '1 day')
              AND (SELECT count(*) FROM job_events e WHERE e.job_id = jobs.id AND kind = 'progress')
                > 2 * %(keep)s
        ), ranked AS (
            SELECT job_events.id, count(*) OVER (PARTITION BY job_id) AS total,
                row_number() OVER (PARTITION BY job_id ORDER BY job_events.id DESC) AS place
            FROM job_events JOIN long ON long.id = job_events.job_id WHERE kind = 'progress'
        )
        DELETE FROM job_events USING ranked
        WHERE job_events.id = ranked.id AND ranked.place < ranked.total
          AND (ranked.place - 1) %% (ranked.total / %(keep)s) <> 0
        """,
        {"keep": max_events},
    )
    return cursor.rowcount


async def _expired_ids(connection: Connection, table: str) -> list[uuid.UUID]:
    query = sql.SQL("SELECT id FROM {} WHERE expires_at < now() AND NOT pinned ORDER BY expires_at LIMIT %s")
    async with connection.transaction():  # which ends here, so that each is forgotten in one of its own
        cursor = await connection.execute(query.format(sql.Identifier(table)), [_BATCH_SIZE])
        return [row["id"] for row in await cursor.fetchall()]


async def _delete_expired_job(connection: Connection, job_id: uuid.UUID) -> bool:
    try:
        async with connection.transaction():
            job = await get_job(connection, job_id)
            if job is None:
                return False
            await lock_owner(connection, job.owner)
            await about_to_lock_jobs(connection)
            cursor = await connection.execute(
                "SELECT owner FROM jobs WHERE id = %s AND expires_at < now() AND NOT pinned FOR UPDATE",
                [job_id],
            )
            row = await cursor.fetchone()
            if row is None:
                return False
            await delete_job(connection, job_id)
    except ConflictError:
        return False  # unfinished jobs work on its results; later, then
    logger.info("job %s of %s has expired", job_id, row["owner"])
    return True


async def _delete_expired_dataset(connection: Connection, dataset_id: uuid.UUID) -> bool:
    async with connection.transaction():
        dataset = await get_dataset(connection, dataset_id)
        if dataset is None:
            return False
        await lock_owner(connection, dataset.owner)
        dataset = await get_dataset(connection, dataset_id, lock=True)
        if dataset is None or dataset.pinned or dataset.expires_at is None or dataset.state == "checking":
            return False
        cursor = await connection.execute(
            """
            DELETE FROM datasets WHERE id = %s AND expires_at < now()
              AND NOT EXISTS (SELECT 1 FROM jobs WHERE datasets.id IN (dataset_id, files_id))
            """,
            [dataset_id],
        )
        if not cursor.rowcount:
            return False
    logger.info("dataset %s of %s has expired", dataset_id, dataset.owner)
    return True
