"""Scenes that the service fetches for a client: by the command ``submit``, and in Python."""

import hashlib
import io
import json
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from click.testing import CliRunner

import octasplat as osp
from octasplat.workers.cli.main import cli
from octasplat.workers.client.api import Api, ServiceError
from tests.support.front_end import FrontEnd
from tests.support.model_builder import ColmapModelBuilder, photographs
from tests.support.zip_builder import ZipMember, build_zip

SCENE = {**photographs(), **ColmapModelBuilder().files()}
ARCHIVE = build_zip(*(ZipMember(name, content) for name, content in SCENE.items()))


class Elsewhere(SimpleHTTPRequestHandler):
    asked: list[str]

    def do_GET(self) -> None:
        self.asked.append(self.path)
        is_there = self.path.startswith("/fox.zip")
        self.send_response(200 if is_there else 404)
        self.send_header("Content-Length", str(len(ARCHIVE) if is_there else 0))
        self.end_headers()
        self.wfile.write(ARCHIVE if is_there else b"")

    def log_message(self, format: str, *arguments: object) -> None:
        """Write no log."""


@pytest.fixture
def elsewhere() -> Iterator[str]:
    Elsewhere.asked = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), Elsewhere)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


@pytest.mark.exhaustive
def test_scene_at_an_address_is_fetched_checked_and_queued(
    conninfo: str, tmp_path: Path, elsewhere: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with FrontEnd(conninfo, tmp_path, OCTASPLAT_IMPORT_HOSTS="127.0.0.1") as front:
        monkeypatch.setenv("OCTASPLAT_SERVER", front.address)
        monkeypatch.setenv("OCTASPLAT_TOKEN", front.token)
        url = f"{elsewhere}/fox.zip?key=1"
        told = CliRunner().invoke(cli, ["submit", url, "--preset", "fast", "--json"])
        assert told.exit_code == 0, told.output
        job = json.load(io.StringIO(told.stdout))
        with Api(front.address, front.token) as api:
            dataset = api.get(f"/v1/datasets/{job['dataset_id']}")
        assert (dataset["name"], dataset["state"], dataset["has_poses"]) == ("fox", "committed", True)
        assert dataset["photographs"] == len(photographs())
        missing = CliRunner().invoke(cli, ["submit", f"{elsewhere}/no.zip"])
        assert missing.exit_code == 1 and "The address answered 404." in missing.stderr
        with osp.Client(front.address, front.token) as client:
            digest = hashlib.sha256(ARCHIVE).hexdigest()
            Elsewhere.asked.clear()
            ids = {client.import_dataset(url, sha256=digest) for _ in range(2)}
            assert len(ids) == 1 and Elsewhere.asked == ["/fox.zip?key=1"]
            assert client.import_dataset(url, sha256=None) not in ids
            with Api(front.address, front.token) as api:
                api.request("DELETE", f"/v1/datasets/{ids.pop()}")
            assert client.import_dataset(url, sha256=digest) == client.import_dataset(url, sha256=digest)
            with pytest.raises(ServiceError, match="SHA-256"):
                client.import_dataset(url, sha256="0" * 64)
