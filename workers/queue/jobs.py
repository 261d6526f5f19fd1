"""Changes of jobs by users: created, listed, retried, deleted.

Every function takes a connection and works in one transaction of its own or of the caller's.
"""

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, LiteralString

from octasplat.workers.db.connections import Connection, fetch_all, fetch_one
from octasplat.workers.db.errors import ConflictError, NotFoundError
from octasplat.workers.db.events_and_logs import add_event, add_events
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.locks import about_to_lock_jobs, lock_owner
from octasplat.workers.db.postgres_text import as_json, as_json_or_null, storable_text
from octasplat.workers.db.rows import Artifact, Job
from octasplat.workers.queue.protocol import JobQueue, NewEntry

JobOrder = Literal["newest", "oldest", "name", "psnr", "longest"]
"""Newest first, oldest first, by name, best PSNR first, longest work first."""
_MATCHING: LiteralString = """
    (%(owner)s::text IS NULL OR owner = %(owner)s)
      AND (cardinality(%(states)s::text[]) = 0 OR state = ANY(%(states)s))
      AND (%(kind)s::text IS NULL OR kind = %(kind)s)
      AND (%(label)s::text IS NULL OR label = %(label)s)
      AND (%(dataset)s::uuid IS NULL OR dataset_id = %(dataset)s)
      AND root_id IS NULL
      AND (%(text)s::text IS NULL OR strpos(lower(coalesce(label, '')), lower(%(text)s)) > 0
           OR strpos(kind, lower(%(text)s)) > 0 OR right(id::text, length(%(text)s)) = lower(%(text)s)
           OR EXISTS (SELECT FROM datasets AS d WHERE d.id = jobs.dataset_id
                      AND strpos(lower(d.name), lower(%(text)s)) > 0))
    """
_NEWEST_JOBS: LiteralString = (
    "SELECT {} FROM jobs WHERE (%(before)s::uuid IS NULL OR id < %(before)s) AND "  # noqa: S608 - constants
    + _MATCHING
    + "ORDER BY id DESC LIMIT %(limit)s"
)
_OLDEST_JOBS: LiteralString = _NEWEST_JOBS.replace("id < ", "id > ").replace("id DESC", "id")
# All keys ascend, so that one comparison of rows begins the next page; jobs without a value get 1: last.
_KEYS: LiteralString = """
    CASE WHEN %(order)s = 'name' THEN
        lower(coalesce(label, (SELECT d.name FROM datasets AS d WHERE d.id = jobs.dataset_id), kind))
        ELSE '' END,
    CASE %(order)s
        WHEN 'psnr' THEN -coalesce(psnr, -1)::float8
        WHEN 'longest' THEN
            -coalesce(extract(epoch FROM finished_at - coalesce(begun_at, started_at)), -1)::float8
        ELSE 0 END,
    id
    """
_ORDERED_JOBS: LiteralString = (
    "SELECT {} FROM jobs WHERE (%(before)s::uuid IS NULL OR ("  # noqa: S608 - constants
    + _KEYS
    + ") > (SELECT "
    + _KEYS
    + " FROM jobs WHERE id = %(before)s AND (%(owner)s::text IS NULL OR owner = %(owner)s))) AND "
    + _MATCHING
    + "ORDER BY "
    + _KEYS
    + "LIMIT %(limit)s"
)


@dataclass(frozen=True)
class NewJob:
    """Values from which a job is created; see :class:`octasplat.workers.db.rows.Job`."""

    owner: str
    kind: str
    options: Mapping[str, Any]
    queue: str
    priority: int = 0
    dataset_id: uuid.UUID | None = None
    source_id: uuid.UUID | None = None
    label: str | None = None
    traceparent: str | None = None
    estimate: Mapping[str, Any] | None = None
    files_id: uuid.UUID | None = None
    requested: Mapping[str, Any] | None = None
    root_id: uuid.UUID | None = None
    role: str | None = None
    place: int | None = None


@dataclass(frozen=True)
class RevisedOptions:
    """Options in the place of those of a job that is tried again; see :class:`octasplat.workers.db.rows.Job`.

    Attributes:
        options: without defaults.
        requested: as asked for; None where those before are not known so.
        settings: every option, of a job that goes on from its checkpoint.
        estimate: what the job will take.
    """

    options: Mapping[str, Any]
    requested: Mapping[str, Any] | None
    settings: Mapping[str, Any] | None
    estimate: Mapping[str, Any] | None


async def create_job(connection: Connection, job_queue: JobQueue, new: NewJob) -> Job:
    """Write the job and its queue entry in one transaction."""
    async with connection.transaction():
        [job_id] = await create_jobs(connection, job_queue, [new])
        return await _get_job_or_raise(connection, job_id)


async def create_jobs(connection: Connection, job_queue: JobQueue, jobs: Sequence[NewJob]) -> list[uuid.UUID]:
    """Write jobs and their queue entries in one transaction, in their order; return their ids."""
    if not jobs:
        return []
    async with connection.transaction():
        ids = [new_id() for _ in jobs]
        entries = [NewEntry(job_id, new.queue, new.priority) for job_id, new in zip(ids, jobs, strict=True)]
        entry_ids = await job_queue.enqueue_all(connection, entries)
        rows = [
            _row_of_job(job_id, new, entry_id)
            for job_id, new, entry_id in zip(ids, jobs, entry_ids, strict=True)
        ]
        await connection.execute(
            """
            INSERT INTO jobs (id, owner, kind, dataset_id, source_id, label, options, queue, priority, slip,
                              traceparent, estimate, files_id, requested, root_id, role, place)
            SELECT * FROM jsonb_to_recordset(%s) AS new (
                id uuid, owner text, kind text, dataset_id uuid, source_id uuid, label text, options jsonb,
                queue text, priority integer, slip bigint, traceparent text, estimate jsonb, files_id uuid,
                requested jsonb, root_id uuid, role text, place bigint)
            """,
            [as_json(rows)],
        )
        # What a new job uses is not about to expire any more.
        used = {used_id for new in jobs for used_id in (new.dataset_id, new.files_id) if used_id is not None}
        for dataset_id in sorted(used):
            await connection.execute(
                "UPDATE datasets SET used_at = now(), expires_at = NULL WHERE id = %s", [dataset_id]
            )
        await add_events(connection, ids, 0, "state", {"state": "queued"})
        return ids


def _row_of_job(job_id: uuid.UUID, new: NewJob, entry_id: int) -> dict[str, Any]:
    """Return a new job as JSON values by the names of its columns."""
    row = {field.name: getattr(new, field.name) for field in fields(NewJob)}
    texts = {name: str(value) for name, value in row.items() if isinstance(value, uuid.UUID)}
    mappings = {name: dict(value) for name, value in row.items() if isinstance(value, Mapping)}
    place = entry_id if new.place is None else new.place
    return {**row, **texts, **mappings, "id": str(job_id), "slip": entry_id, "place": place}


async def get_job(connection: Connection, job_id: uuid.UUID, *, lock: bool = False) -> Job | None:
    """Return the job of that id, or None; with ``lock`` nobody else changes it until the transaction ends."""
    query = "SELECT {} FROM jobs WHERE id = %s FOR UPDATE" if lock else "SELECT {} FROM jobs WHERE id = %s"
    if lock:
        await about_to_lock_jobs(connection)
    return await fetch_one(connection, Job, query, [job_id])


async def list_jobs(
    connection: Connection,
    *,
    owner: str | None = None,
    states: Sequence[str] = (),
    kind: str | None = None,
    label: str | None = None,
    dataset_id: uuid.UUID | None = None,
    text: str | None = None,
    before: uuid.UUID | None = None,
    order: JobOrder = "newest",
    limit: int = 50,
) -> list[Job]:
    """Return the jobs that match, in an order.

    Args:
        connection: to the database.
        owner: whose; None takes everybody's.
        states: in one of these states; none given takes all.
        kind: of this kind.
        label: with this label.
        dataset_id: on this dataset.
        text: with this in the label, the kind or the name of the dataset, or at the end of the id.
        before: that come behind this job; none where it is gone or another's, but by age.
        order: which come first.
        limit: at most so many.
    """
    return await fetch_all(
        connection,
        Job,
        {"newest": _NEWEST_JOBS, "oldest": _OLDEST_JOBS}.get(order, _ORDERED_JOBS),
        {
            "text": text,
            "owner": owner,
            "states": list(states),
            "kind": kind,
            "label": label,
            "dataset": dataset_id,
            "before": before,
            "order": order,
            "limit": limit,
        },
    )


async def lock_blocks(connection: Connection, root_id: uuid.UUID) -> list[Job]:
    """Lock the blocks of a job, which comes before its own lock; return them by their ids."""
    await about_to_lock_jobs(connection)
    query = "SELECT {} FROM jobs WHERE root_id = %s ORDER BY id FOR UPDATE"
    return await fetch_all(connection, Job, query, [root_id])


async def retry_job(
    connection: Connection,
    job_queue: JobQueue,
    job_id: uuid.UUID,
    *,
    from_start: bool,
    revised: RevisedOptions | None = None,
) -> Job:
    """Queue a failed or cancelled job again.

    Args:
        connection: to the database.
        job_queue: the queue.
        job_id: which.
        from_start: begin from the start, not from the newest checkpoint.
        revised: options in the place of the job's own.

    Raises:
        ConflictError: it is neither failed nor cancelled, or is a block of another.
        NotFoundError: there is no such job.
    """
    async with connection.transaction():
        # The owner's lock comes before the row's, see workers.db.locks.
        await lock_owner(connection, (await _get_job_or_raise(connection, job_id)).owner)
        await lock_blocks(connection, job_id)
        job = await _get_job_or_raise(connection, job_id, lock=True)
        job.refuse_block()
        if job.state not in ("failed", "canceled"):
            raise ConflictError(f"Only failed and canceled jobs are retried; this one is {job.state}.")
        # What was to go on with its blocks and was cancelled before that is begun anew.
        await connection.execute(
            """
            UPDATE jobs SET rescues = 0, error = NULL, stage = NULL, step = NULL, total_steps = NULL,
                seconds_left = NULL, finished_at = NULL, worker = NULL, expires_at = NULL, begun_at = NULL,
                continuations = array_remove(continuations, attempt + 1),
                checkpoint = CASE WHEN %(fresh)s THEN NULL ELSE checkpoint END,
                begun_anew = CASE WHEN %(fresh)s THEN NULL ELSE begun_anew END,
                psnr = CASE WHEN %(fresh)s THEN NULL ELSE psnr END,
                training_psnr = CASE WHEN %(fresh)s THEN NULL ELSE training_psnr END,
                fresh_after = CASE WHEN %(forget)s THEN attempt ELSE fresh_after END
            WHERE id = %(id)s
            """,
            {
                "fresh": from_start,
                "forget": from_start or revised is not None,
                "id": job_id,
            },
        )
        if revised is not None:
            await _revise_options(connection, job_id, revised)
        if from_start:
            await connection.execute("DELETE FROM jobs WHERE root_id = %s", [job_id])
        await requeue_job(connection, job_queue, job)
        return await _get_job_or_raise(connection, job_id)


async def _revise_options(connection: Connection, job_id: uuid.UUID, revised: RevisedOptions) -> None:
    await connection.execute(
        """
        UPDATE jobs SET options = %s, estimate = %s, settings = %s,
            resolved_by = CASE WHEN %s THEN resolved_by END
        WHERE id = %s
        """,
        [
            as_json(dict(revised.options)),
            as_json_or_null(revised.estimate),
            as_json_or_null(revised.settings),
            revised.settings is not None,
            job_id,
        ],
    )
    # By itself: where the options change alone, the database takes it for a front end that knows no others.
    query = "UPDATE jobs SET requested = %s WHERE id = %s"
    await connection.execute(query, [as_json_or_null(revised.requested), job_id])


async def requeue_job(
    connection: Connection,
    job_queue: JobQueue,
    job: Job,
    *,
    keep_entry: bool = False,
    delay_seconds: float = 0.0,
    without_event: bool = False,
    reason: str | None = None,
) -> None:
    """Put a job back into its queue with a new entry; the caller holds the job's lock.

    A job that has an entry, as it was interrupted or not even begun, keeps its place: it goes before all that
    were queued after it. One that was over goes last.

    Args:
        connection: of the transaction.
        job_queue: the queue.
        job: which.
        keep_entry: the old queue entry is being delivered and goes by itself when that ends.
        delay_seconds: for how long it is not taken up.
        without_event: it never ceased to be queued, so that nobody needs to hear of it.
        reason: why, for its owner; None where it only waits for its turn.
    """
    if job.slip is not None and not keep_entry:
        await job_queue.remove(connection, job.slip)
    entry = NewEntry(job.id, job.queue, job.priority, job.slip, delay_seconds)
    entry_id = await job_queue.enqueue(connection, entry)
    await connection.execute(
        """
        UPDATE jobs SET slip = %(entry)s, place = %(place)s, waits_for = %(reason)s, delayed_until =
            CASE WHEN %(delay)s > 0 THEN now() + make_interval(secs => %(delay)s) END
        WHERE id = %(job)s
        """,
        {
            "entry": entry_id,
            "place": entry_id if job.slip is None and job.root_id is None else job.place_in_queue,
            "reason": None if reason is None else storable_text(reason),
            "delay": delay_seconds,
            "job": job.id,
        },
    )
    if without_event:
        return
    await connection.execute(
        """
        UPDATE jobs SET state = 'queued', queued_at = now(), started_at = NULL, worker = NULL,
            seconds_left = NULL
        WHERE id = %s
        """,
        [job.id],
    )
    await add_event(connection, job.id, job.attempt, "state", {"state": "queued"})


async def change_job(
    connection: Connection,
    job_id: uuid.UUID,
    *,
    label: str | None,
    pinned: bool,
    view_notes: Sequence[Mapping[str, Any]] | None = None,
) -> Job:
    """Set the label of a job, whether it is pinned, and its notes if given; a pinned job does not expire."""
    await connection.execute(
        """
        UPDATE jobs SET label = %(label)s, pinned = %(pinned)s,
            view_notes = coalesce(%(view_notes)s, view_notes),
            expires_at = CASE WHEN %(pinned)s THEN NULL ELSE expires_at END
        WHERE id = %(id)s
        """,
        {"label": label, "pinned": pinned, "view_notes": as_json_or_null(view_notes), "id": job_id},
    )
    return await _get_job_or_raise(connection, job_id)


async def delete_job(connection: Connection, job_id: uuid.UUID) -> None:
    """Delete a finished job; its blobs stay until they are collected.

    Raises:
        ConflictError: it is not over, other jobs work on its results, or it is a block of another.
        NotFoundError: there is no such job.
    """
    async with connection.transaction():
        await lock_owner(connection, (await _get_job_or_raise(connection, job_id)).owner)
        await lock_blocks(connection, job_id)  # which go with it
        job = await _get_job_or_raise(connection, job_id, lock=True)
        job.refuse_block()
        if not job.is_over:
            raise ConflictError(f"The job is {job.state}; cancel it first.")
        cursor = await connection.execute(
            """
            SELECT count(*) AS n FROM jobs
            WHERE source_id = %s AND state IN ('queued', 'running', 'canceling')
            """,
            [job_id],
        )
        row = await cursor.fetchone()
        if row and row["n"]:
            raise ConflictError(f"{row['n']} unfinished jobs work on this job's results; cancel them first.")
        await connection.execute("UPDATE jobs SET source_id = NULL WHERE source_id = %s", [job_id])
        await connection.execute("DELETE FROM jobs WHERE id = %s", [job_id])


async def artifacts_of(connection: Connection, job_id: uuid.UUID) -> list[Artifact]:
    """Return the results of a job, by name."""
    return await fetch_all(
        connection, Artifact, "SELECT {} FROM artifacts WHERE job_id = %s ORDER BY name", [job_id]
    )


async def get_artifact(connection: Connection, job_id: uuid.UUID, name: str) -> Artifact | None:
    """Return one result of a job, or None."""
    return await fetch_one(
        connection, Artifact, "SELECT {} FROM artifacts WHERE job_id = %s AND name = %s", [job_id, name]
    )


async def _get_job_or_raise(connection: Connection, job_id: uuid.UUID, *, lock: bool = False) -> Job:
    job = await get_job(connection, job_id, lock=lock)
    if job is None:
        raise NotFoundError("job")
    return job
