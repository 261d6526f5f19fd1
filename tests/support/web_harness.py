"""A running service as the tests of its pages see it."""

import json
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.support.run_replay import RunReplay
from tests.support.service_harness import BEARER

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class RunningService:
    """A service that runs.

    Attributes:
        url: where.
        store: its folder of contents.
        worker: plays a worker's part.
    """

    url: str
    store: Path
    worker: RunReplay

    def request(self, method: str, path: str, body: object = None, **headers: str) -> Any:
        """The JSON that the API answers."""
        data = body if isinstance(body, bytes) else None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(
            self.url + path, data=data, method=method, headers={**BEARER, **headers}
        )
        if body is not None and not isinstance(body, bytes):
            request.add_header("Content-Type", "application/json")
        with urllib.request.urlopen(request, timeout=60) as answer:
            text = answer.read()
        return json.loads(text) if text else None


StartService = Callable[..., RunningService]
Browse = Callable[..., dict[str, Any]]
