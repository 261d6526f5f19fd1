"""A job that is interrupted, by a restart or a kill, is not left behind those that wait."""

import uuid

import pytest

from tests.support.worker_harness import MAX_WAIT_SECONDS, WorkerHarness


def begun(bench: WorkerHarness) -> list[tuple[uuid.UUID, int]]:
    """Jobs and attempts in the order in which they began."""
    rows = bench.run_query(lambda connection: _starts(connection))
    return [(row["job_id"], row["attempt"]) for row in rows]


async def _starts(connection):  # type: ignore[no-untyped-def]
    cursor = await connection.execute(
        "SELECT job_id, attempt FROM job_events "
        "WHERE kind = 'state' AND data->>'state' = 'running' ORDER BY id"
    )
    return await cursor.fetchall()


@pytest.mark.exhaustive
@pytest.mark.parametrize("kill", [False, True], ids=["planned restart", "kill"])
def test_interrupted_job_keeps_queue_position(bench: WorkerHarness, kill: bool) -> None:
    worker = bench.worker(name="first")
    long_one = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(long_one)
    tiny = [bench.submit(options={"steps": 1, "seconds": 0.0}) for _ in range(12)]
    bench.open_gate()
    if kill:
        worker.kill()
        worker.wait()
        bench.worker(queues="", name="care", STALE_SECONDS="3")  # finds out that the first is lost
        bench.wait(long_one, lambda job: job.state == "queued")
    else:
        worker.terminate()
        assert worker.wait(MAX_WAIT_SECONDS) == 0
    bench.worker(name="second")
    job = bench.wait_until_finished(long_one)
    bench.wait_until_finished(tiny[1])
    assert (job.state, job.attempt) == ("succeeded", 2)
    assert begun(bench)[:3] == [(long_one, 1), (long_one, 2), (tiny[0], 1)]
