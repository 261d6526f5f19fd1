"""A server that answers as a function says, for tests of the client."""

import json
import threading
from collections.abc import Callable, Iterator
from http.server import ThreadingHTTPServer
from typing import Any

import pytest

from tests.support.http_server import QuietHandler

Answer = tuple[int, dict[str, str], bytes]


class Front:
    """A server that answers as a function says; None breaks the connection off after half of the answer."""

    def __init__(self, answer: Callable[[str, str, dict[str, str], bytes], Answer]) -> None:
        self.asked: list[str] = []
        front = self

        class Handler(QuietHandler):
            def respond(self) -> None:
                length = int(self.headers.get("Content-Length") or 0)
                body = self.rfile.read(length)
                front.asked.append(f"{self.command} {self.path}")
                status, headers, content = answer(self.command, self.path, dict(self.headers), body)
                self.answer(content, status, **headers)

        self._handler = Handler
        self.port = 0
        self.start()

    def start(self) -> None:
        self._server = ThreadingHTTPServer(("127.0.0.1", self.port), self._handler)
        self.port = int(self._server.server_address[1])
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()

    def stop(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def start_again_after(self, seconds: float) -> None:
        self.stop()
        threading.Timer(seconds, self.start).start()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"


@pytest.fixture
def serve() -> Iterator[Callable[..., Front]]:
    fronts: list[Front] = []

    def make(answer: Callable[[str, str, dict[str, str], bytes], Answer]) -> Front:
        fronts.append(Front(answer))
        return fronts[-1]

    yield make
    for front in fronts:
        front.stop()


def as_json(value: Any, status: int = 200) -> Answer:
    return status, {"Content-Type": "application/json"}, json.dumps(value).encode()


def as_page(status: int) -> Answer:
    return status, {"Content-Type": "text/html"}, b"<html>from a proxy</html>"
