"""The client waits for a service that is started again, and says what stands in its place."""

import hashlib
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from octasplat.workers.client import backoff
from octasplat.workers.client.api import Api, ServiceError, ServiceUnreachableError
from octasplat.workers.client.download import download_results
from octasplat.workers.client.watch import watch_job
from tests.support.scripted_front import Answer, Front, as_json, as_page, serve

__all__ = ["serve"]

AWAY_SECONDS = 12.5
"""What a restart takes where one slow upload holds it up."""


@pytest.mark.parametrize("known", [True, False])
def test_requests_survive_service_restart(serve: Callable[..., Front], known: bool) -> None:
    front = serve(lambda *_: as_json({"fine": True}))
    with Api(front.address) as api:
        if known:
            api.get("/v1")
        front.start_again_after(AWAY_SECONDS)
        assert api.get("/v1") == {"fine": True}


def test_refused_connection_is_told_without_waiting(
    serve: Callable[..., Front], monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(backoff.time, "sleep", pauses.append)
    front = serve(lambda *_: as_json({}))
    front.stop()
    with (
        Api(front.address, awaits_start=False) as api,
        pytest.raises(ServiceUnreachableError, match="octasplat serve"),
    ):
        api.get("/v1/jobs")
    assert pauses == []


def test_service_that_has_answered_is_awaited_in_any_case(serve: Callable[..., Front]) -> None:
    front = serve(lambda *_: as_json({"fine": True}))
    with Api(front.address, awaits_start=False) as api:
        api.get("/v1")
        front.start_again_after(0.5)
        assert api.get("/v1") == {"fine": True}


def test_missing_service_fails_quickly(serve: Callable[..., Front], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("octasplat.workers.client.api.MAX_FIRST_OUTAGE_SECONDS", 1.0)
    front = serve(lambda *_: as_json({}))
    front.stop()
    began = time.monotonic()
    with Api(front.address) as api, pytest.raises(ServiceUnreachableError, match="octasplat serve"):
        api.get("/v1")
    front.start()
    assert time.monotonic() - began < 10


def test_pauses_grow_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, pauses = [0.0], list[float]()

    def sleep(seconds: float) -> None:
        pauses.append(seconds)
        clock[0] += seconds

    monkeypatch.setattr(backoff.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(backoff.time, "sleep", sleep)
    waiting = backoff.Backoff(120.0)
    while waiting.wait():
        pass
    assert sum(pauses) == pytest.approx(120.0) and 12 <= len(pauses) <= 30
    assert pauses[0] < 0.5 and max(pauses) <= 10.0
    waiting.reset()
    for asked in (5.0, 60.0):  # also where a service asks for more than the longest pause of its own accord
        assert waiting.wait(min_seconds=asked) and pauses[-1] == asked
    assert waiting.wait(min_seconds=600.0) and pauses[-1] == pytest.approx(55.0)
    assert not waiting.wait()


def test_redirect_raises_error_with_target(serve: Callable[..., Front], tmp_path: Path) -> None:
    elsewhere = {"Location": "https://other.example/v1"}
    front = serve(lambda *_: (308, elsewhere, b""))
    with Api(front.address) as api:
        for ask in (lambda: api.get("/v1"), lambda: api.request("PUT", "/v1", content=b"x")):
            with pytest.raises(
                ServiceError, match=r"redirected to https://other.example/v1.*OCTASPLAT_SERVER"
            ):
                ask()


def test_foreign_response_is_not_accepted(serve: Callable[..., Front]) -> None:
    front = serve(lambda *_: as_page(200))
    with Api(front.address) as api, pytest.raises(ServiceError, match=r"text/html.*no octasplat service"):
        api.get("/v1")


@pytest.mark.parametrize("status", [502, 503, 504])
def test_gateway_error_is_retried(serve: Callable[..., Front], status: int) -> None:
    left = [3]

    def answer(_method: str, path: str, _headers: dict[str, str], _body: bytes) -> Answer:
        if left[0]:
            left[0] -= 1
            return as_page(status)
        if path.endswith("/events"):
            left[0] = 0
            return 200, {"Content-Type": "text/event-stream"}, b""
        return as_json({"state": "succeeded"})

    front = serve(answer)
    with Api(front.address) as api:
        assert watch_job(api, "x", lambda _e: None, lambda _s: None)["state"] == "succeeded"


def test_lasting_gateway_error_is_reported(
    serve: Callable[..., Front], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("octasplat.workers.client.api.MAX_FIRST_OUTAGE_SECONDS", 0.5)
    front = serve(lambda *_: as_page(502))
    with Api(front.address) as api, pytest.raises(ServiceUnreachableError, match="a proxy answers 502"):
        api.get("/v1")


def test_interrupted_download_resumes_with_long_names(serve: Callable[..., Front], tmp_path: Path) -> None:
    content = bytes(range(256)) * 64
    name = "n" * 236 + ".bin"
    sha256 = hashlib.sha256(content).hexdigest()

    def answer(_method: str, path: str, headers: dict[str, str], _body: bytes) -> Answer:
        if path.endswith("/artifacts"):
            return as_json({"artifacts": [{"name": name, "sha256": sha256, "size_bytes": len(content)}]})
        begin = int(headers.get("Range", "bytes=0-")[6:-1])
        rest = content[begin:]
        return (206 if begin else 200), {"Content-Length": str(len(rest))}, rest[: len(content) // 8]

    front = serve(answer)
    with Api(front.address) as api:
        [path] = download_results(api, "x", tmp_path)
    assert path.read_bytes() == content and path.name == name
    assert sum("n" * 200 in asked for asked in front.asked) == 8
    assert [left.name for left in tmp_path.iterdir()] == [name]
