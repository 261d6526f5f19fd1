"""A program that is told: an HTTP server of this machine that keeps what it hears."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import ThreadingHTTPServer

from tests.support.http_server import QuietHandler


@dataclass
class WebhookReceiver:
    """What came, and what is answered: the next of ``statuses``, the last of them for good."""

    port: int = 0
    statuses: list[int] = field(default_factory=lambda: [204])
    received: list[tuple[str, dict[str, str], bytes]] = field(default_factory=list)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}/hook"


class _Server(ThreadingHTTPServer):
    request_queue_size = 128
    """By default 5: of 40 messages at once some would knock again and again, up to their limit."""


@contextmanager
def receive_webhooks(*statuses: int) -> Iterator[WebhookReceiver]:
    """Hear messages until the block ends."""
    receiver = WebhookReceiver(statuses=list(statuses) or [204])

    class Handler(QuietHandler):
        def respond(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            receiver.received.append((self.path, {k.lower(): v for k, v in self.headers.items()}, body))
            status = receiver.statuses[0] if len(receiver.statuses) == 1 else receiver.statuses.pop(0)
            elsewhere = {"Location": f"{receiver.url}/elsewhere"} if status in (301, 302, 307, 308) else {}
            self.answer(b"", status, **elsewhere)

    with _Server(("127.0.0.1", 0), Handler) as server:
        receiver.port = server.server_address[1]
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield receiver
        finally:
            server.shutdown()
            thread.join()
