"""Notes in the 3D view of a job that several people have open, in headless Chromium."""

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from test_page_parts import make_job

from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.workers.db.connections import open_pool
from tests.support.shell_scene import shell_scene
from tests.support.web_harness import Browse, RunningService

pytestmark = [pytest.mark.tools, pytest.mark.heavy]


async def _job_with_scene(database: str, sha256: str, size_bytes: int, notes: list[dict[str, Any]]) -> str:
    job_id = await make_job(database)
    async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
        await connection.execute(
            "UPDATE jobs SET state = 'succeeded', attempt = 1, finished_at = now(), view_notes = %s "
            "WHERE id = %s",
            [json.dumps(notes), job_id],
        )
        await connection.execute(
            "INSERT INTO artifacts (job_id, name, sha256, size_bytes, media_type) "
            "VALUES (%s, 'scene.ply', %s, %s, 'application/octet-stream')",
            [job_id, sha256, size_bytes],
        )
    return str(job_id)


@pytest.mark.exhaustive
def test_notes_that_others_wrote_meanwhile_are_kept(
    service: RunningService, browse: Browse, database: str, tmp_path: Path
) -> None:
    notes = [
        {"text": text, "position": [k, 0.5, 0], "camera": [0, 0, 3, 0, 0, 0]}
        for k, text in enumerate(("first", "second", "of somebody else"))
    ]
    path = tmp_path / "scene.ply"
    write_gaussian_ply(shell_scene(), path)
    stored = (service.worker.store(path), path.stat().st_size)
    job = asyncio.run(_job_with_scene(database, *stored, notes[:2]))
    found = browse("notes", service.url, job=job, notes=notes, seconds=90)
    kept = service.request("GET", f"/v1/jobs/{job}")["view_notes"]
    assert [note["text"] for note in kept] == ["second", "of somebody else"] == found["shown"]
    assert found["complaints"] == []
