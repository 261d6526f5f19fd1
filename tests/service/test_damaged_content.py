"""Contents of the store that a disk has changed: named by backups, never handed out as if they were sound."""

import asyncio
import io
import logging
import zipfile
from pathlib import Path

import httpx
import pytest

from octasplat.service import downloads
from octasplat.service.state import Service
from octasplat.workers.queue.job_results import ResultFile
from tests.service.test_backup import octasplat
from tests.support.service_harness import ConnectService, claim_job, new_job, running_service, store_content

SOUND, BAD = b"sound " * 1000, b"a result " * 1000


async def job_with_results(http: httpx.AsyncClient, service: Service) -> str:
    """A finished job with the results ``sound.txt`` and ``bad.txt``."""
    job = await new_job(http, service, options={"steps": 1})
    attempt = await claim_job(service, job)
    await attempt.succeed(
        [
            ResultFile(name, store_content(service, content), len(content), "text/plain")
            for name, content in (("bad.txt", BAD), ("sound.txt", SOUND))
        ]
    )
    return str(job["id"])


def damage(store: Path, *, shorten: bool = False) -> None:
    """Change the stored content of ``bad.txt``, in its bytes or its length."""
    for path in (store / "blobs").rglob("*"):
        if path.is_file() and path.read_bytes() == BAD:
            path.chmod(0o600)
            path.write_bytes(BAD[:-1] if shorten else BAD[:-1] + b"!")


@pytest.mark.parametrize("shorten", [False, True])
@pytest.mark.parametrize("asked", [{}, {"Range": "bytes=0-9"}])
async def test_damaged_download_is_an_error(
    connect_service: ConnectService, tmp_path: Path, shorten: bool, asked: dict[str, str]
) -> None:
    async with connect_service() as (http, service):
        job = await job_with_results(http, service)
        damage(tmp_path / "store", shorten=shorten)
        answer = await http.get(f"/v1/jobs/{job}/artifacts/bad.txt", headers=asked)
        assert answer.status_code == 500
        assert answer.json()["type"] == "urn:octasplat:problem:damaged"
        assert (await http.get(f"/v1/jobs/{job}/artifacts/sound.txt")).content == SOUND


async def test_damage_found_while_sending_ends_the_answer_early(
    connect_service: ConnectService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(downloads, "SMALL_BYTES", 100)
    async with connect_service() as (http, service):
        job = await job_with_results(http, service)
        assert (await http.get(f"/v1/jobs/{job}/artifacts/bad.txt")).content == BAD
        everything = (await http.get(f"/v1/jobs/{job}/archive")).content
        assert zipfile.ZipFile(io.BytesIO(everything)).read("bad.txt") == BAD
        damage(tmp_path / "store")
        for name in ("artifacts/bad.txt", "archive"):
            with pytest.raises(RuntimeError):  # which a server answers by closing the connection
                await http.get(f"/v1/jobs/{job}/{name}")
        assert (await http.get(f"/v1/jobs/{job}/artifacts/sound.txt")).content == SOUND


async def test_backup_names_damaged_contents_and_goes_on(conninfo: str, tmp_path: Path) -> None:
    here, backup = tmp_path / "here", tmp_path / "backup"
    async with running_service(conninfo, here) as (http, service):
        job = await job_with_results(http, service)
        damage(here / "store")
        saved = await asyncio.to_thread(octasplat, conninfo, here, "backup", backup)
        assert saved.returncode == 1
        named, summary = saved.stderr.splitlines()
        assert f"result bad.txt of the job {job} is damaged" in named
        assert summary.startswith("Error: 1 contents could not be copied")
        copied = [path.read_bytes() for path in (backup / "store" / "blobs").rglob("*") if path.is_file()]
        assert copied == [SOUND] and (backup / "backup.json").exists()


async def test_full_store_is_ready_and_takes_no_uploads(conninfo: str, tmp_path: Path) -> None:
    async with running_service(conninfo, tmp_path, floor_bytes=1 << 60) as (http, _):
        answer = await http.get("/readyz")
        assert (answer.status_code, answer.json()["status"]) == (200, "ok")
        assert answer.json()["checks"]["uploads"] == "full"
        assert answer.json()["checks"]["storage"] == "ok"


async def test_full_store_is_told_at_the_start(
    conninfo: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        async with running_service(conninfo, tmp_path, floor_bytes=1 << 60):
            pass
    assert any("takes no uploads" in record.message for record in caplog.records)
