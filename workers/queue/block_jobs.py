"""Jobs in blocks: a root, which is seen, and children, each of which trains a block as a job of its own.

The root plans the blocks and then waits, running without a heartbeat. ``job_needs`` says for what; whichever
child succeeds last puts it back into the queue, and its last attempt makes the results of theirs. All that
ends children goes on by :func:`settle_root`, which may be called at any time and is repeated with the
recovery of lost jobs, so that nothing depends on the process that should have called it.

Rows are locked in the order of the children's ids, and the root's after them.
"""

import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from octasplat.engine.core.errors import CheckpointError
from octasplat.workers.db.connections import Connection, fetch_all
from octasplat.workers.db.errors import ConflictError, NotFoundError
from octasplat.workers.db.events_and_logs import add_event
from octasplat.workers.db.live_scenes import get_shown_scene
from octasplat.workers.db.postgres_text import as_json
from octasplat.workers.db.rows import TERMINAL, Job
from octasplat.workers.queue.job_endings import end_job
from octasplat.workers.queue.jobs import NewJob, create_jobs, get_job, lock_blocks, requeue_job
from octasplat.workers.queue.protocol import JobQueue

CompleteOptions = Callable[[Mapping[str, Any]], Mapping[str, Any] | None]
"""Returns every option of a block as this version understands those given; None if it does not."""
ROOT, BLOCK = "root", "block"
"""Roles of jobs in blocks; other jobs have none."""


@dataclass(frozen=True)
class NewBlock:
    """A block to be trained by a job of its own.

    Attributes:
        number: of the block, from 1.
        iterations: which tell how long it takes, beside others.
        options: of its job; what a job with the same options has made is kept.
        disk_bytes: that its job takes on the disk of its worker; None takes those of the whole job.
    """

    number: int
    iterations: int
    options: Mapping[str, Any]
    disk_bytes: int | None = None


async def start_blocks(
    connection: Connection,
    job_queue: JobQueue,
    root: Job,
    kind: str,
    blocks: Sequence[NewBlock],
    *,
    first_steps: int,
    total_steps: int,
    complete: CompleteOptions = dict,
) -> None:
    """Queue the blocks of a job, which waits for them from now on; the caller has locked both.

    Blocks that an earlier attempt has queued are kept if their options mean the same: those that succeeded
    are not trained again.

    Args:
        connection: of the transaction.
        job_queue: the queue.
        root: the job.
        kind: of the blocks' jobs.
        blocks: all of them.
        first_steps: iterations before the blocks, which are done.
        total_steps: iterations of the whole job.
        complete: completes options of a block, which another version may have written.
    """
    kept: dict[int, Job] = {}
    wanted = {block.number: complete(block.options) for block in blocks}
    for child in await blocks_of(connection, [root.id]):
        number = int(child.options["number"])
        # One that is being cancelled would take the job along when it ends.
        is_usable = child.state != "canceling" and number in wanted
        if is_usable and complete(child.options) == wanted[number]:
            kept[number] = child
        else:
            await connection.execute("DELETE FROM jobs WHERE id = %s", [child.id])
    # The longest first, so that none is left over in the end.
    ordered = sorted(blocks, key=lambda block: (-block.iterations, block.number))
    needed = []
    for known in (kept[block.number] for block in ordered if block.number in kept):
        if known.state == "succeeded":
            continue
        if known.is_over:
            await connection.execute(
                """
                UPDATE jobs SET rescues = 0, error = NULL, finished_at = NULL, stage = NULL, step = NULL,
                    total_steps = NULL WHERE id = %s
                """,
                [known.id],
            )
            await requeue_job(connection, job_queue, replace(known, place=root.place_in_queue))
        needed.append(known.id)
    new = [_job_of_block(root, kind, block) for block in ordered if block.number not in kept]
    needed += await create_jobs(connection, job_queue, new)
    if not needed and await _has_begun_to_merge_anew(connection, root):
        message = (
            "Two attempts could not go on with what all blocks have made, and a third would end so, too; "
            "the warnings in the log say why. Retry the job from the start."
        )
        await end_job(connection, root, "failed", {"type": CheckpointError.error_type, "message": message})
        return
    await connection.execute(
        "INSERT INTO job_needs (job_id, needs_id) SELECT %s, unnest(%s::uuid[]) ON CONFLICT DO NOTHING",
        [root.id, needed],
    )
    await connection.execute(
        """
        UPDATE jobs SET role = %s, heartbeat_at = NULL, worker = NULL, seconds_left = NULL, rescues = 0,
            begun_at = coalesce(begun_at, started_at), stage = 'train', step = %s, total_steps = %s
        WHERE id = %s
        """,
        [ROOT, first_steps, total_steps, root.id],
    )
    data = {"blocks": len(blocks), "done": sum(child.state == "succeeded" for child in kept.values())}
    await add_event(connection, root.id, root.attempt, "blocks_queued", data)


async def _has_begun_to_merge_anew(connection: Connection, root: Job) -> bool:
    """Return whether a job has planned blocks before that were all trained, since it was last accepted.

    That happens once where its checkpoint is lost, and again and again where the results cannot be merged.
    """
    cursor = await connection.execute(
        """
        SELECT id FROM job_events
        WHERE job_id = %(job)s AND attempt > %(fresh)s AND kind = 'blocks_queued'
          AND data->'done' = data->'blocks' AND id > coalesce((
            SELECT max(id) FROM job_events
            WHERE job_id = %(job)s AND kind = 'state' AND data->>'state' = ANY(%(over)s)), 0)
        LIMIT 1
        """,
        {"job": root.id, "fresh": root.fresh_after, "over": list(TERMINAL)},
    )
    return await cursor.fetchone() is not None


async def release_needs(connection: Connection, job_queue: JobQueue | None, child: Job) -> None:
    """Queue the jobs that need nothing more now that a child has succeeded; called in that transaction.

    Without a queue they are left to :func:`settle_root`.
    """
    cursor = await connection.execute(
        "DELETE FROM job_needs WHERE needs_id = %s RETURNING job_id", [child.id]
    )
    for row in await cursor.fetchall():
        root = await get_job(connection, row["job_id"], lock=True)
        if root is None or not root.waits_for_blocks:
            continue
        left = await _count_needs(connection, root.id)
        data = {"block": int(child.options["number"]), "left": left}
        await add_event(connection, root.id, root.attempt, "block_finished", data)
        await add_live_scene_event(connection, root)
        if job_queue is not None and root.state == "running" and not left:
            await _continue_root(connection, job_queue, root)


async def add_live_scene_event(connection: Connection, job: Job) -> None:
    """Tell what is shown of a job's training, if there is anything; the caller holds the job's lock."""
    shown = await get_shown_scene(connection, job.id)
    if shown is not None:
        data = {"step": shown.step, "gaussians": shown.gaussians}
        await add_event(connection, job.id, job.attempt, "live_scene", data)


async def settle_root(connection: Connection, job_queue: JobQueue, root_id: uuid.UUID) -> None:
    """Bring a job that waits for its blocks to where these are; does nothing to most others.

    A block that failed ends the others and then the job; where the job is being canceled, so are its blocks,
    and where it is over without success those that are left: a job that was restored from a backup is queued
    beside its blocks.
    """
    # As a rule there is nothing to do, for which not every block has to be locked.
    if not await unsettled_roots(connection, root_id):
        return
    async with connection.transaction():
        children = await lock_blocks(connection, root_id)
        root = await get_job(connection, root_id, lock=True)
        if root is not None and root.state in ("failed", "canceled"):
            for child in children:
                await _cancel(connection, job_queue, child)
        if root is None or not root.waits_for_blocks:
            return
        ended = [child for child in children if child.state in ("failed", "canceled")]
        if root.state == "running" and ended:
            root = await _give_up(connection, root, ended, len(children))
        if root.state == "running":
            if not await _count_needs(connection, root.id):
                await _continue_root(connection, job_queue, root)
            return
        for child in children:
            await _cancel(connection, job_queue, child)
        if all(child.is_over or child.state == "queued" for child in children):
            await end_job(connection, root, "canceled" if root.error is None else "failed", root.error)


async def unsettled_roots(connection: Connection, root_id: uuid.UUID | None = None) -> list[uuid.UUID]:
    """Return the jobs whose blocks may let them go on or end, or have to end; of all, or of the one given."""
    cursor = await connection.execute(
        """
        SELECT id FROM jobs AS root
        WHERE state IN ('running', 'canceling') AND heartbeat_at IS NULL AND role = %(role)s
          AND (%(id)s::uuid IS NULL OR id = %(id)s) AND (
            state = 'canceling' OR NOT EXISTS (SELECT FROM job_needs WHERE job_id = root.id)
            OR EXISTS (SELECT FROM jobs WHERE root_id = root.id AND state IN ('failed', 'canceled')))
        UNION
        SELECT root.id FROM jobs AS block JOIN jobs AS root ON root.id = block.root_id
        WHERE block.state IN ('queued', 'running') AND root.state IN ('failed', 'canceled')
          AND (%(id)s::uuid IS NULL OR block.root_id = %(id)s)
        ORDER BY id
        """,
        {"role": ROOT, "id": root_id},
    )
    return [row["id"] for row in await cursor.fetchall()]


async def blocks_of(connection: Connection, roots: Sequence[uuid.UUID]) -> list[Job]:
    """Return the jobs of the blocks of some jobs, by number."""
    query = "SELECT {} FROM jobs WHERE root_id = ANY(%s) ORDER BY root_id, (options->>'number')::int"
    return await fetch_all(connection, Job, query, [list(roots)]) if roots else []


async def cancel_job(connection: Connection, job_queue: JobQueue, job_id: uuid.UUID) -> Job:
    """Cancel a job: at once while it is queued, by its worker when it runs; may be repeated.

    Raises:
        ConflictError: it succeeded or failed already, or is a block of another.
        NotFoundError: there is no such job.
    """
    async with connection.transaction():
        await lock_blocks(connection, job_id)
        job = await get_job(connection, job_id, lock=True)
        if job is None:
            raise NotFoundError("job")
        job.refuse_block()
        if job.state in ("succeeded", "failed"):
            raise ConflictError(f"The job is over ({job.state}), so it cannot be cancelled.")
        await _cancel(connection, job_queue, job)
        await settle_root(connection, job_queue, job_id)
        canceled = await get_job(connection, job_id)
        assert canceled is not None
        return canceled


async def _cancel(connection: Connection, job_queue: JobQueue, job: Job) -> None:
    """Cancel a job that is not over; the caller holds its lock."""
    if job.state == "queued":
        if job.slip is not None:
            await job_queue.remove(connection, job.slip)
        await connection.execute(
            "UPDATE jobs SET state = 'canceled', finished_at = now(), slip = NULL WHERE id = %s", [job.id]
        )
        await add_event(connection, job.id, job.attempt, "state", {"state": "canceled"})
    elif job.state == "running":
        await connection.execute("UPDATE jobs SET state = 'canceling' WHERE id = %s", [job.id])
        await add_event(connection, job.id, job.attempt, "state", {"state": "canceling"})


async def _give_up(connection: Connection, root: Job, ended: Sequence[Job], count: int) -> Job:
    """Begin to end a job of which blocks have ended without success; return it as it is then."""
    failed = [child for child in ended if child.state == "failed"]
    error = None
    if failed:
        first = min(failed, key=lambda child: (child.finished_at is None, child.finished_at, child.id))
        number, reason = int(first.options["number"]), first.error or {}
        message = (
            f"Block {number} of {count} failed: {reason.get('message', '')} The others' results are kept."
        )
        error = {"type": reason.get("type", "block_failed"), "message": message, "block": number}
    await connection.execute(
        "UPDATE jobs SET state = 'canceling', error = %s WHERE id = %s",
        [None if error is None else as_json(error), root.id],
    )
    await add_event(connection, root.id, root.attempt, "state", {"state": "canceling"})
    return replace(root, state="canceling", error=error)


async def _continue_root(connection: Connection, job_queue: JobQueue, root: Job) -> None:
    """Queue a job whose blocks are done; its next attempt is a part of the same start."""
    # Its own steps were those before the blocks; it is as far as they all are from now on.
    await connection.execute(
        """
        UPDATE jobs SET continuations = continuations || %(next)s,
            step = least(total_steps, coalesce(step, 0) + (
                SELECT coalesce(sum((options->>'iterations')::int), 0) FROM jobs WHERE root_id = %(id)s))
        WHERE id = %(id)s
        """,
        {"next": [root.attempt + 1], "id": root.id},
    )
    await requeue_job(connection, job_queue, root)


async def _count_needs(connection: Connection, job_id: uuid.UUID) -> int:
    cursor = await connection.execute("SELECT count(*) AS n FROM job_needs WHERE job_id = %s", [job_id])
    row = await cursor.fetchone()
    assert row is not None
    return int(row["n"])


def _job_of_block(root: Job, kind: str, block: NewBlock) -> NewJob:
    estimate = root.estimate
    if estimate is not None and block.disk_bytes is not None:
        estimate = {**estimate, "disk_bytes": block.disk_bytes}
    return NewJob(
        owner=root.owner,
        kind=kind,
        options=block.options,
        queue=root.queue,
        priority=root.priority,
        dataset_id=root.dataset_id,
        label=f"block {block.number}",
        traceparent=root.traceparent,
        estimate=estimate,
        root_id=root.id,
        role=BLOCK,
        place=root.place_in_queue,
    )
