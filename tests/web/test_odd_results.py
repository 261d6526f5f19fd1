"""Pages of results that lack a part."""

import json
import uuid

from test_page_parts import make_job

from octasplat.service.state import Service
from tests.support.service_harness import ConnectService, store_content


async def finished_job(service: Service, database: str, results: dict[str, bytes]) -> uuid.UUID:
    job_id = await make_job(database)
    async with service.pool.connection() as connection:
        await connection.execute(
            "UPDATE jobs SET state = 'succeeded', attempt = 1, finished_at = now() WHERE id = %s", [job_id]
        )
        for name, content in results.items():
            await connection.execute(
                "INSERT INTO artifacts (job_id, name, sha256, size_bytes, media_type) "
                "VALUES (%s, %s, %s, %s, 'application/octet-stream')",
                [job_id, name, store_content(service, content), len(content)],
            )
    return job_id


async def test_page_of_measured_views_without_renders_is_shown(
    connect_service: ConnectService, database: str
) -> None:
    metrics = {"mean": {"psnr": 25.0}, "views": {"a.jpg": {"psnr": 25.0}}}
    async with connect_service() as (http, service):
        job_id = await finished_job(service, database, {"metrics.json": json.dumps(metrics).encode()})
        page = await http.get(f"/jobs/{job_id}")
    assert page.status_code == 200 and 'data-sort="a.jpg"' in page.text
    assert 'id="view-shown"' not in page.text
