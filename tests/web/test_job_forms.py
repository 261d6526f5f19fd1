"""Every kind of job can be asked for on a page, and what it makes is shown there."""

import asyncio
import uuid
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from test_page_parts import make_job

from octasplat.workers.db.connections import open_pool
from octasplat.workers.worker.job_kinds import job_kinds
from tests.support.service_harness import running_service

RESULTS = (
    "scene.ply", "config.json", "held_out.json", "views.json", "training.json", "events.jsonl",
    "environment.hdr", "background.exr",
)  # fmt: skip
"""What a finished reconstruction with materials has."""


@pytest.fixture
def pages(database: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[str, str]]:
    """The page of a finished job with these results, and the one for new jobs."""

    async def finished(*names: str) -> uuid.UUID:
        job_id = await make_job(database)
        async with open_pool(database, max_size=1, wait_seconds=10) as pool, pool.connection() as connection:
            await connection.execute(
                "UPDATE jobs SET state = 'succeeded', attempt = 1, finished_at = now() WHERE id = %s",
                [job_id],
            )
            for name in names:
                await connection.execute(
                    "INSERT INTO artifacts (job_id, name, sha256, size_bytes, media_type) "
                    "VALUES (%s, %s, %s, 4, 'application/octet-stream')",
                    [job_id, name, "0" * 64],
                )
        return job_id

    def look(*names: str) -> tuple[str, str]:
        async def ask() -> tuple[str, str]:
            job_id = await finished(*names)
            async with running_service(database, tmp_path) as (http, _):
                answers: list[httpx.Response] = [await http.get(path) for path in (f"/jobs/{job_id}", "/new")]
                assert [answer.status_code for answer in answers] == [200, 200]
                return answers[0].text, answers[1].text

        return asyncio.run(ask())

    return look


def test_job_kinds_have_form_pages(pages: Callable[..., tuple[str, str]]) -> None:
    job, new = pages(*RESULTS)
    for kind in job_kinds():
        if not kind.program.startswith("octasplat."):  # of another test
            continue
        if kind.name == "relight":
            assert 'id="relight"' in job
        elif kind.needs == "result":
            assert f'data-kind="{kind.name}"' in job, kind.name
        else:
            assert f'data-kind="{kind.name}"' in new, kind.name


def test_form_asks_for_files_named_by_options(pages: Callable[..., tuple[str, str]]) -> None:
    job, new = pages(*RESULTS)
    assert 'type="file" multiple required data-path="meshes"' in job
    assert 'type="file" required data-path="source"' in new


def test_scene_opens_in_the_viewer(pages: Callable[..., tuple[str, str]]) -> None:
    job, _ = pages("scene.ply", "mesh.glb")
    assert 'id="viewer"' in job and 'id="mesh-viewer"' not in job


def test_mesh_without_a_scene_opens_in_the_viewer(pages: Callable[..., tuple[str, str]]) -> None:
    job, _ = pages("surface.glb")
    assert 'id="mesh-viewer"' in job and "/artifacts/surface.glb" in job
    assert "/static/viewer/mesh_page.js" in job
