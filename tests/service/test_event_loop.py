"""No request of the largest allowed size holds the event loop for 100 ms, whatever it is full of.

What is measured is the processor time of the loop's own thread in each of its steps, which other processes of
the machine do not lengthen.
"""

import asyncio
import gc
import gzip
import json
import re
import threading
import time
from asyncio import events
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import pytest

from octasplat.service.json_bounds import find_excess, parse_in_pieces
from octasplat.service.routes.scene_previews import MAX_BODY_BYTES
from tests.support.daily import some_daily
from tests.support.service_harness import ConnectService, new_job

LARGEST_BYTES = 1 << 20
LONGEST_SECONDS = 0.1
NOBODY = "00000000-0000-0000-0000-000000000000"
MESH = {"shape": "cube", "position": [1, 2, 3], "scale": 0.5}


def render(**options: Any) -> dict[str, Any]:
    return {"kind": "render", "source_id": NOBODY, "options": options}


SHAPES: dict[str, Callable[[], bytes]] = {
    "many members": lambda: json.dumps({f"k{number}": 1 for number in range(70_000)}).encode(),
    "as many members as are allowed": lambda: json.dumps(
        {"kind": "reconstruct", "options": {f"k{a}": {f"k{b}": 1 for b in range(90)} for a in range(500)}}
    ).encode(),
    "a long name": lambda: json.dumps({"name": "x" * 1_000_000, "kind": "x", "url": "x"}).encode(),
    "escapes": lambda: b'{"name":"' + b"\\u0041" * 170_000 + b'"}',
    "escaped quotes that nothing closes": lambda: b'{"name":"' + b'\\"' * 500_000,
    "quotes": lambda: b'"' * LARGEST_BYTES,
    "empty lists": lambda: b'{"options":[' + b"[]," * 340_000 + b"1]}",
    "as many lists as are allowed": lambda: b'{"options":[' + b"[]," * 24_000 + b"1]}",
    "deep lists": lambda: b'{"options":[' + (b"[" * 900 + b"]" * 900 + b",") * 570 + b"1]}",
    "one deep list": lambda: b'{"options":' + b"[" * 500_000 + b"]" * 500_000 + b"}",
    "long numbers": lambda: b'{"options":[' + (b"1" * 4000 + b",") * 250 + b"1]}",
    "many numbers": lambda: b'{"options":[' + b"1e3," * 250_000 + b"1]}",
    "no JSON": lambda: b"x" * LARGEST_BYTES,
    "a stage": lambda: json.dumps(render(stage={"meshes": [MESH] * 6000})).encode(),
    "a stage as text": lambda: json.dumps(render(stage="[[meshes]]\nshape = 'cube'\n" * 9000)).encode(),
    "a path of cameras": lambda: json.dumps(
        render(mode="path", camera_path={"keyframes": [{"position": [1, 2, 3]}] * 9000})
    ).encode(),
    "assignments": lambda: json.dumps(
        {"kind": "reconstruct", "options": {"set": ["lr.mean=0.001"] * 49_000}}
    ).encode(),
    "as many assignments as are allowed": lambda: json.dumps(
        {"kind": "reconstruct", "options": {"set": ["lr.mean=0.001"] * 1000}}
    ).encode(),
    "photographs": lambda: json.dumps(
        {"kind": "reconstruct", "photographs": [{"width_px": 9, "height_px": 9, "count": 1}] * 12_000}
    ).encode(),
    "events and scopes": lambda: json.dumps({"events": ["x"] * 24_000, "scopes": ["read"] * 24_000}).encode(),
}


class LoopWatch:
    """The longest step of the event loop."""

    def __init__(self) -> None:
        self.longest_seconds, self.step = 0.0, ""

    def reset(self) -> None:
        self.__init__()  # type: ignore[misc]


@contextmanager
def watched_loop() -> Iterator[LoopWatch]:
    """Measure each step of the loop of this thread in seconds of the processor."""
    watch, loop_thread, run = LoopWatch(), threading.get_ident(), events.Handle._run

    def run_measured(handle: events.Handle) -> None:
        if threading.get_ident() != loop_thread:
            run(handle)
            return
        begun = time.thread_time()
        run(handle)
        if (taken := time.thread_time() - begun) > watch.longest_seconds:
            watch.longest_seconds, watch.step = taken, repr(handle)[:300]

    events.Handle._run = run_measured  # type: ignore[method-assign]
    gc.collect()
    gc.freeze()  # as the front end does; what the tests have loaded is not of it
    try:
        yield watch
    finally:
        gc.unfreeze()
        events.Handle._run = run  # type: ignore[method-assign]


async def routes_with_json(http: httpx.AsyncClient) -> list[tuple[str, str]]:
    document = (await http.get("/openapi.json")).json()
    return [
        (method.upper(), path)
        for path, operations in document["paths"].items()
        for method, operation in operations.items()
        if "application/json" in operation.get("requestBody", {}).get("content", {})
    ]


ALWAYS = {"many members", "one deep list"}
"""One of each sort; the other shapes are exhaustive."""


@pytest.mark.parametrize("name", some_daily(SHAPES, ALWAYS))
async def test_no_body_of_json_holds_the_loop(connect_service: ConnectService, name: str) -> None:
    body = SHAPES[name]()[:LARGEST_BYTES]
    held = {}
    async with connect_service() as (http, service):
        job = await new_job(http, service)
        routes = await routes_with_json(http)
        assert len(routes) > 10
        ids = {"dataset_id": job["dataset_id"]}
        await http.post("/v1/estimates", json={"kind": "reconstruct", "options": {"unknown": 1}})
        with watched_loop() as watch:
            for method, path in routes:
                url = re.sub(r"\{(\w+)\}", lambda found: ids.get(found[1], job["id"]), path)
                await asyncio.sleep(0)
                watch.reset()
                headers = {"Content-Type": "application/json"}
                answer = await http.request(method, url, content=body, headers=headers, timeout=300)
                assert answer.status_code < 500, (path, answer.text[:300])
                if watch.longest_seconds > LONGEST_SECONDS:
                    held[method, path] = (watch.longest_seconds, watch.step)
    assert not held


@pytest.mark.exhaustive
async def test_largest_preview_does_not_hold_the_loop(connect_service: ConnectService) -> None:
    files = [{"path": f"images/{number:06}{'x' * 80}.jpg", "size_bytes": 1} for number in range(100_000)]
    body = json.dumps({"files": files}).encode()
    async with connect_service() as (http, _):
        headers = {"Content-Type": "application/json"}
        with watched_loop() as watch:
            answer = await http.post("/v1/scene-previews", content=body, headers=headers, timeout=300)
            assert answer.status_code == 200 and watch.longest_seconds < LONGEST_SECONDS, vars(watch)
            watch.reset()
            await asyncio.sleep(0)
            zeros = bytes(MAX_BODY_BYTES)
            await http.post("/v1/scene-previews/archive?size_bytes=99999999", content=zeros, timeout=300)
            assert watch.longest_seconds < LONGEST_SECONDS, vars(watch)
        assert len(answer.json()["files"]) == 100_000


async def test_document_and_options_do_not_hold_the_loop(connect_service: ConnectService) -> None:
    async with connect_service() as (http, _):
        for path in ("/openapi.json", "/v1/options", "/v1/options/reconstruct"):
            with watched_loop() as watch:
                assert (await http.get(path, timeout=300)).status_code == 200
                assert watch.longest_seconds < LONGEST_SECONDS, (path, vars(watch))


@pytest.mark.parametrize(
    "value",
    [
        {}, [], 1, "x", {"a": []}, {"a": [1, [2, {"b": 3}], "]"], "c": {"d": [4]}, "e": None},
        {"files": [{"path": "a,]}", "size_bytes": 1}], "f": "\"\\"},
    ],
)  # fmt: skip
@pytest.mark.parametrize("indent", [None, 3])
def test_json_in_pieces_is_what_it_is_in_one(value: Any, indent: int | None) -> None:
    assert parse_in_pieces(json.dumps(value, indent=indent).encode()) == value


@pytest.mark.parametrize(
    "text", ["", "{", "[1,", '{"a"}', '{"a":}', '{"a":[1,]}', '{"a":[1 2]}', '{"a":1,}', '{"a":1}}', '{1:2}',
             '{"a":[}', '{"a":[1]', "{} x"],
)  # fmt: skip
def test_what_is_no_json_is_refused_in_pieces_too(text: str) -> None:
    with pytest.raises(json.JSONDecodeError):
        parse_in_pieces(text.encode())


def test_excess_is_found_in_the_structure_alone() -> None:
    assert find_excess(json.dumps({"a": '[{,"' * 100_000, "b": [1] * 49_000}).encode()) is None
    assert find_excess(b"[" * 24 + b"]" * 24) is None
    assert find_excess(json.dumps({f"k{number}": [] for number in range(512)}).encode()) is None
    for body, code in (
        (b"[" * 25 + b"]" * 25, "too_deep"),
        (json.dumps({f"k{number}": 1 for number in range(513)}).encode(), "too_many_members"),
        (b"[" + b"1," * 50_001 + b"1]", "too_many_values"),
        (b'["' + b'","' * 110_000 + b'"]', "too_many_values"),
        (b"[" + b"9" * 401 + b"]", "too_long_number"),
    ):
        found = find_excess(body)
        assert found is not None and found[0] == code


@pytest.mark.parametrize(
    "body",
    ['{"name": "é"}'.encode("latin-1"), gzip.compress(b'{"name": "a"}', mtime=0)],
    ids=["latin-1", "gzip"],
)
def test_a_body_that_is_no_utf_8_is_refused_with_what_to_do(body: bytes) -> None:
    assert find_excess(body) == (
        "encoding",
        "The body is no text in UTF-8, in which JSON is read; send it so, and not compressed.",
    )


@pytest.mark.parametrize("piece", [b"]", b"9" * 400 + b" ", b'"\\', b"1 "])
def test_excess_is_looked_for_in_a_time_by_the_length(piece: bytes) -> None:
    body = piece * (MAX_BODY_BYTES // len(piece))
    begun = time.thread_time()
    find_excess(body)
    assert time.thread_time() - begun < 2.0


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32"])
async def test_json_is_read_in_utf_8_alone(connect_service: ConnectService, encoding: str) -> None:
    # Bytes of these characters are quotation marks, which would hide the brackets behind them.
    body = ('{"name": "\u2200", "x": ' + "[" * 100 + "]" * 100 + "}").encode(encoding)
    found = find_excess(body)
    assert found is not None and found[0] == "encoding"
    async with connect_service() as (http, _):
        answer = await http.post("/v1/datasets", content=body, headers={"Content-Type": "application/json"})
        assert answer.status_code == 422 and "UTF-8" in answer.json()["detail"]
