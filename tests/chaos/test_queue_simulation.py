"""The simulation of benchmarks/queue_simulation.py in short: no block is lost, or done twice with effect."""

import asyncio
from pathlib import Path

import psycopg
import pytest

from benchmarks.queue_deliveries import empty_database
from benchmarks.queue_simulation import Simulation, queue_roots, report

pytestmark = pytest.mark.heavy


@pytest.mark.exhaustive
def test_blocks_without_work_survive_kills_of_their_workers(short_root: Path) -> None:
    server, conninfo = empty_database(short_root / "simulated")
    store = short_root / "store"
    store.mkdir()
    try:
        asyncio.run(queue_roots(conninfo, roots=2, blocks=10, owners=2))
        simulation = Simulation(conninfo, server.home, store, processes=2, workers=2, seed=1)
        found = report(simulation, simulation.run(kills=2, seconds_between=4.0))
        assert (found["jobs"], found["faults"]) == (22, {})
        # What must hold is looked at: a block that is told of twice is a fault.
        with psycopg.connect(conninfo, autocommit=True) as connection:
            connection.execute(
                "INSERT INTO job_events (job_id, attempt, kind, data) SELECT job_id, attempt, kind, data "
                "FROM job_events WHERE data->>'state' = 'succeeded' LIMIT 1"
            )
        assert report(simulation, 1.0)["faults"] == {"jobs that succeeded other than once": 1}
    finally:
        server.stop()
