"""``octasplat usage`` and ``octasplat download --archive`` against a service of two answers."""

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

from octasplat.workers.cli.main import cli
from tests.support.http_server import QuietHandler, serve_http

JOB = "01a1fcac-4f59-764b-97e6-1be68502c58f"
USAGE = {
    "owner": "me", "bytes": {"used": 5, "limit": 1000}, "datasets": {"used": 1, "limit": None},
    "jobs": {"used": 2, "limit": 7}, "job_seconds": 185.0,
}  # fmt: skip


def archive_of(content: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("scene.ply", content)
    return file.getvalue()


class Answers(QuietHandler):
    archive = archive_of(b"ply\n")

    def respond(self) -> None:
        known = {
            "/v1/usage": json.dumps(USAGE).encode(),
            f"/v1/jobs/{JOB}": json.dumps({"id": JOB}).encode(),
            f"/v1/jobs/{JOB}/artifacts": json.dumps({"artifacts": [{"size_bytes": 4}]}).encode(),
            f"/v1/jobs/{JOB}/archive": self.archive,
        }
        self.answer(known[self.path])


@pytest.fixture
def server() -> Iterator[str]:
    with serve_http(Answers) as address:
        yield address


def test_usage_shows_what_is_used_of_what_is_allowed(server: str) -> None:
    done = CliRunner().invoke(cli, ["usage", "--server", server])
    assert done.exit_code == 0, done.output
    assert done.output.splitlines() == [
        "Owner: me", "bytes: 5 of 1000", "datasets: 1 of any number", "unfinished jobs: 2 of 7",
        "time of jobs: 3:05 min",
    ]  # fmt: skip
    assert json.loads(CliRunner().invoke(cli, ["usage", "--json", "--server", server]).output) == USAGE


def test_archive_is_saved_once_it_is_whole(
    server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "all.zip"
    command = ["download", JOB, "--archive", str(place), "--server", server]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 0, done.output
    assert zipfile.ZipFile(place).read("scene.ply") == b"ply\n"
    monkeypatch.setattr(Answers, "archive", archive_of(b"other").replace(b"other", b"wrong"))
    again = CliRunner().invoke(cli, command)
    assert again.exit_code != 0
    assert zipfile.ZipFile(place).read("scene.ply") == b"ply\n"
    assert [path.name for path in tmp_path.iterdir()] == ["all.zip"]
    assert CliRunner().invoke(cli, [*command, "scene.ply"]).exit_code == 2
