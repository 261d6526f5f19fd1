"""A job is followed to its end although the service is away for a while."""

import json
import threading
import time
from http.server import ThreadingHTTPServer

import pytest

from octasplat.workers.client import api
from octasplat.workers.client.watch import watch_job
from tests.support.http_server import QuietHandler


class Front(QuietHandler):
    """Ends each stream of events after one, as one that is stopped does; in the end the job is over."""

    state = "running"

    def respond(self) -> None:
        body = b'id: 1\nevent: state\ndata: {"state": "running"}\n\n'
        if not self.path.endswith("/events"):
            body = json.dumps({"state": self.state}).encode()
        self.answer(body)


def serving(address: tuple[str, int]) -> ThreadingHTTPServer:
    server = ThreadingHTTPServer(address, Front)
    threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    return server


def test_watch_job_survives_long_outage(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api, "MAX_FIRST_OUTAGE_SECONDS", 0.5)
    monkeypatch.setattr(api, "MAX_OUTAGE_SECONDS", 0.5)
    server = serving(("127.0.0.1", 0))
    host, port = server.server_address[0], server.server_address[1]
    found: list[str] = []
    heard = threading.Event()  # a service that never answered is not waited for
    with api.Api(f"http://127.0.0.1:{port}") as client:

        def watch() -> None:
            found.append(watch_job(client, "x", lambda _event: None, lambda _state: heard.set())["state"])

        watching = threading.Thread(target=watch, daemon=True)
        watching.start()
        assert heard.wait(30)
        server.shutdown()
        server.server_close()
        time.sleep(2.5)
        assert watching.is_alive()
        monkeypatch.setattr(Front, "state", "succeeded")
        server = serving((str(host), int(port)))
        watching.join(120)
        server.shutdown()
        server.server_close()
    assert found == ["succeeded"]
