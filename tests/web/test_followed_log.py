"""The log on the page of a job, in headless Chromium."""

import asyncio

import pytest
from test_page_parts import make_job

from octasplat.workers.db.connections import open_pool
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.jobs import get_job
from tests.support.web_harness import Browse, RunningService

pytestmark = [pytest.mark.tools, pytest.mark.heavy]


async def _job_with_log(database: str) -> str:
    job_id = await make_job(database)
    async with open_pool(database, max_size=2, wait_seconds=10) as pool:
        async with pool.connection() as connection:
            job = await get_job(connection, job_id)
        assert job is not None and job.slip is not None
        attempt = await claim(pool, job_id, job.slip, "w")
        assert attempt is not None
        await attempt.add_log_lines(["a line"])
    return str(job_id)


@pytest.mark.exhaustive
def test_log_goes_on_after_a_refused_request_and_after_folding(
    service: RunningService, browse: Browse, database: str
) -> None:
    found = browse("log", service.url, job=asyncio.run(_job_with_log(database)), seconds=90)
    assert found["asked"][:2] == ["0", "0"]
    assert found["lines"] == 1
