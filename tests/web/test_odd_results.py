"""Pages of results that lack a part, and of views with unusual names."""

import json
import uuid

from test_page_parts import make_job

from octasplat.service.state import Service
from octasplat.workers.worker.job_kinds import get_job_kind
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


async def test_choices_of_views_keep_names_with_spaces(
    connect_service: ConnectService, database: str
) -> None:
    # Browsers take the text of a choice without a value, with its spaces drawn together.
    kind = get_job_kind("relight")
    results = dict.fromkeys((*kind.source_files, "renders/two  spaces.png"), b"{}")
    results["held_out.json"] = json.dumps(["two  spaces.jpg"]).encode()
    async with connect_service() as (http, service):
        jobs = [await finished_job(service, database, results) for _ in range(2)]
        job = await http.get(f"/jobs/{jobs[0]}")
        compared = await http.get("/compare", params={"job": [str(job_id) for job_id in jobs]})
    assert '<option value="two  spaces.jpg">' in job.text
    assert '<option value="two  spaces.png" selected>' in compared.text


async def test_pages_go_on_beside_a_newer_version_with_more_columns(
    connect_service: ConnectService, database: str
) -> None:
    async with connect_service() as (http, service):
        job_id = await finished_job(service, database, {"metrics.json": b"{}", "renders/a.png": b""})
        async with service.pool.connection() as connection:
            await connection.execute("ALTER TABLE artifacts ADD COLUMN of_the_next_version integer")
        try:
            for path in ("/", f"/jobs/{job_id}"):
                assert (await http.get(path)).status_code == 200, path
        finally:
            async with service.pool.connection() as connection:
                await connection.execute("ALTER TABLE artifacts DROP COLUMN of_the_next_version")
