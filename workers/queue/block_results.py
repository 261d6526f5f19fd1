"""What the blocks of a job have made, as the job takes it over when it merges them, and when it is lost."""

from collections.abc import Collection

from octasplat.engine.core import versions
from octasplat.engine.core.errors import CheckpointError
from octasplat.workers.db.connections import Connection, fetch_all
from octasplat.workers.db.events_and_logs import add_event, add_log_lines
from octasplat.workers.db.postgres_text import as_json
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.job_results import replace_artifacts
from octasplat.workers.queue.jobs import get_job
from octasplat.workers.storage.errors import BlobNotFoundError
from octasplat.workers.storage.trees import TreeFile

RUN_PREFIX = "run"
"""Folder of an attempt in which the results of blocks belong where they were made."""


async def files_from_others(connection: Connection, job: Job, *, plan: str | None = None) -> list[TreeFile]:
    """Return what a job in blocks takes over from others, by the places in the folder of its attempt.

    A block takes what the root had when it planned them, and the root what its blocks have made.

    Args:
        connection: to the database.
        job: the job.
        plan: of the root, which it goes on with: blocks of another one are left out, as those of a plan that
            a version with other results has made. None takes all.

    Raises:
        CheckpointError: the blocks were planned by a version of other results.
    """
    if job.root_id is not None:
        root = await get_job(connection, job.root_id)
        checkpoint = (root.checkpoint if root is not None else None) or {}
        if checkpoint.get("results", 1) != versions.RESULTS_VERSION:
            raise CheckpointError(
                "The blocks were planned by a version in which the same settings gave other results; retry "
                "the job from the start."
            )
        return [TreeFile.model_validate(file) for file in checkpoint["files"]]
    cursor = await connection.execute(
        """
        SELECT name, sha256, size_bytes FROM artifacts JOIN jobs ON jobs.id = artifacts.job_id
        WHERE jobs.root_id = %(id)s AND jobs.state = 'succeeded'
          AND (%(plan)s::text IS NULL OR jobs.options->>'plan' = %(plan)s) ORDER BY name
        """,
        {"id": job.id, "plan": plan},
    )
    return [
        TreeFile(path=f"{RUN_PREFIX}/{row['name']}", sha256=row["sha256"], size_bytes=row["size_bytes"])
        for row in await cursor.fetchall()
    ]


async def drop_lost_blocks(connection: Connection, root: Job, lost: Collection[str]) -> None:
    """Let the blocks be trained again whose results the store has lost; the caller has locked all of them.

    They are over without success afterwards, and queued when the job that is being merged plans its blocks.

    Args:
        connection: of the transaction.
        root: the job.
        lost: digests of the contents.

    Raises:
        BlobNotFoundError: results of the same block were lost before.
    """
    query = """
        SELECT {} FROM jobs WHERE root_id = %s AND state = 'succeeded' AND EXISTS (
            SELECT FROM artifacts WHERE job_id = jobs.id AND sha256 = ANY(%s)) ORDER BY id
        """
    for child in await fetch_all(connection, Job, query, [root.id, list(lost)]):
        number = int(child.options["number"])
        message = f"The results of block {number} are gone from the store; it is trained again."
        cursor = await connection.execute(
            """
            SELECT id FROM job_events
            WHERE job_id = %s AND attempt > %s AND kind = 'warning' AND data->>'message' = %s
            """,
            [root.id, root.fresh_after, message],
        )
        if await cursor.fetchone() is not None:
            raise BlobNotFoundError(
                f"The results of block {number} are gone from the store once more; see to the store, and "
                "retry the job from the start."
            )
        error = {"type": BlobNotFoundError.error_type, "message": message}
        await replace_artifacts(connection, child, [])
        await connection.execute(
            "UPDATE jobs SET state = 'failed', error = %s, fresh_after = attempt WHERE id = %s",
            [as_json(error), child.id],
        )
        await add_event(connection, root.id, root.attempt, "warning", {"message": message})
        await add_log_lines(connection, root.id, root.attempt, [f"Warning: {message}"])


async def forget_block_results(connection: Connection, root: Job) -> None:
    """Remove what the blocks of a job have made, which is in its own results now."""
    await connection.execute(
        "DELETE FROM artifacts WHERE job_id IN (SELECT id FROM jobs WHERE root_id = %s)", [root.id]
    )
    await connection.execute(
        "DELETE FROM live_scenes WHERE job_id IN (SELECT id FROM jobs WHERE root_id = %s)", [root.id]
    )
