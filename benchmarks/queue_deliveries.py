"""What a delivery of the queue costs, by how many jobs wait and whose they are.

    python -m benchmarks.queue_deliveries --queued 1000 10000 100000 --owners 10

Prints JSON: for each count, milliseconds of a delivery (median and 95th percentile) in its parts: to be
given an entry, to choose the job by the fair share, to begin it, to end it, and to tell how many are ahead;
besides, a heartbeat and a row of progress, which each running job writes all the time.
Jobs do no work; one worker takes them one after the other. The database is a private one without flushing.
"""

import argparse
import asyncio
import itertools
import json
import statistics
import tempfile
import time
import uuid
from collections import defaultdict
from pathlib import Path

import psycopg

from octasplat.workers.db.connections import Pool, open_pool
from octasplat.workers.db.migrate import migrate
from octasplat.workers.postgres.embedded import EmbeddedPostgres
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.fair_share import choose_job, queue_position
from octasplat.workers.queue.jobs import get_job
from octasplat.workers.queue.procrastinate_queue import TASK_NAME, ProcrastinateQueue

QUEUE = "cpu"
_FILL = """
    WITH numbers AS (
        SELECT gen_random_uuid() AS id, 'owner' || (n %% %(owners)s) AS owner
        FROM generate_series(1, %(count)s) n
    ), slips AS (
        INSERT INTO procrastinate_jobs (queue_name, task_name, priority, args)
        SELECT %(queue)s, %(task)s, 0, jsonb_build_object('job_id', id::text) FROM numbers
        RETURNING id, (args->>'job_id')::uuid AS job_id
    )
    INSERT INTO jobs (id, owner, kind, options, queue, priority, slip)
    SELECT numbers.id, owner, 'toy', '{}', %(queue)s, 0, slips.id
    FROM numbers JOIN slips ON job_id = numbers.id
    """


def empty_database(folder: Path, connections: int = 100) -> tuple[EmbeddedPostgres, str]:
    """Start a private Postgres with all tables, which does not flush; returns it and how to connect."""
    server = EmbeddedPostgres(folder, connections=connections)
    conninfo = server.start()
    with psycopg.connect(conninfo, autocommit=True) as connection:
        connection.execute("ALTER SYSTEM SET fsync = off")
        connection.execute("SELECT pg_reload_conf()")
    migrate(conninfo)
    return server, conninfo


async def fill(pool: Pool, count: int, owners: int) -> None:
    """Queue jobs of several owners, without the history that each has."""
    values = {"count": count, "owners": owners, "queue": QUEUE, "task": TASK_NAME}
    async with pool.connection() as connection:
        await connection.execute(_FILL, values)
        await connection.execute("ANALYZE jobs")
        await connection.execute("ANALYZE procrastinate_jobs")


async def measure(pool: Pool, deliveries: int) -> dict[str, dict[str, float]]:
    """Take and end some of the queued jobs; returns milliseconds of each part."""
    queue = ProcrastinateQueue(pool, poll_seconds=0.05)
    times: defaultdict[str, list[float]] = defaultdict(list)
    ended = time.perf_counter()

    async def deliver(job_id: uuid.UUID, entry_id: int) -> None:
        nonlocal ended
        marks = [("entry", ended), ("choice", time.perf_counter())]
        chosen = await choose_job(pool, queue, job_id, entry_id)
        assert chosen is not None
        marks.append(("begin", time.perf_counter()))
        attempt = await claim(pool, *chosen, "worker")
        assert attempt is not None
        marks.append(("heartbeat", time.perf_counter()))
        await attempt.heartbeat()
        marks.append(("progress", time.perf_counter()))
        step = {"iteration": 10, "total_iterations": 100, "seconds_left": 1.0}
        await attempt.set_progress(stage="train", step=10, total_steps=100, event=step)
        marks.append(("end", time.perf_counter()))
        await attempt.succeed([], job_queue=queue)
        marks.append(("", time.perf_counter()))
        for (name, begun), (_, over) in itertools.pairwise(marks):
            times[name].append(1000 * (over - begun))
        times["all"].append(1000 * (marks[-1][1] - marks[0][1]))
        ended = time.perf_counter()
        if len(times["all"]) == deliveries:
            queue.stop()

    await queue.consume(QUEUE, 1, deliver)
    async with pool.connection() as connection:
        row = await (
            await connection.execute("SELECT max(id::text)::uuid AS id FROM jobs WHERE state = 'queued'")
        ).fetchone()
        assert row is not None
        job = await get_job(connection, row["id"])
        assert job is not None
        for _ in range(5):
            begun = time.perf_counter()
            await queue_position(connection, job)
            times["ahead"].append(1000 * (time.perf_counter() - begun))
    return {
        name: {
            "median": round(statistics.median(found), 2),
            "95 %": round(statistics.quantiles(found, n=20)[-1], 2),
        }
        for name, found in times.items()
    }


async def run(conninfo: str, counts: list[int], owners: int, deliveries: int) -> dict[int, object]:
    """Measure each count, the smallest first."""
    found: dict[int, object] = {}
    async with open_pool(conninfo, max_size=6) as pool:
        queued = 0
        for count in sorted(counts):
            await fill(pool, count - queued, owners)
            found[count] = await measure(pool, deliveries)
            queued = count - deliveries
    return found


def main() -> None:
    """Parse the command line and print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--queued", type=int, nargs="+", default=[1_000, 10_000, 100_000])
    parser.add_argument("--owners", type=int, default=10)
    parser.add_argument("--deliveries", type=int, default=200)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="octasplat-queue-") as folder:
        Path(folder).chmod(0o711)
        server, conninfo = empty_database(Path(folder) / "data")
        try:
            found = asyncio.run(run(conninfo, arguments.queued, arguments.owners, arguments.deliveries))
        finally:
            server.stop()
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
