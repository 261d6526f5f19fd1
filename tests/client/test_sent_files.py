"""Files that the client sends: once, over a few connections, and none that the service has already."""

import hashlib
import json
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.workers.client import backoff
from octasplat.workers.client.api import Api, ServiceError
from octasplat.workers.client.resumable_upload import send_resumable
from octasplat.workers.client.submission import Derivation, Submission, derive, submit
from octasplat.workers.client.upload import upload_files
from tests.support.scripted_front import Answer, Front, as_json, as_page, serve

__all__ = ["serve"]


class Datasets:
    """A service that keeps datasets, and forgets what is deleted."""

    def __init__(self) -> None:
        self.made: dict[str, dict[str, Any] | None] = {}
        self.uploads = 0
        self.refusals = 0

    def __call__(self, method: str, path: str, headers: dict[str, str], _body: bytes) -> Answer:
        problem = {"detail": "no"}
        if path == "/v1/datasets":
            key = headers["Idempotency-Key"]
            if key in self.made and self.made[key] is None:
                return as_json(problem, 404)
            dataset = self.made.setdefault(key, {"id": f"d{len(self.made)}", "state": "open"})
            return as_json(dataset)
        dataset = next(d for d in self.made.values() if d is not None and d["id"] == path.split("/")[3])
        if path.endswith("/commit"):
            if self.refusals:
                self.refusals -= 1
                dataset["state"] = "checking"
                return as_json({"detail": "The dataset is being checked already."}, 409)
            dataset["state"] = "committed"
            return as_json(dataset)
        if "/files" in path:
            if method == "PUT":
                self.uploads += 1
            return as_json({"files": [], "next": None})
        return as_json(dataset)


def test_upload_after_dataset_deletion_is_sent_once(serve: Callable[..., Front], tmp_path: Path) -> None:
    service = Datasets()
    (tmp_path / "a.obj").write_text("x")
    files = {"a.obj": tmp_path / "a.obj"}
    with Api(serve(service).address) as api:
        upload_files(api, files)
        for _ in range(3):
            service.made = dict.fromkeys(service.made)
            for _ in range(3):
                upload_files(api, files)
    assert service.uploads == 1 + 3


def test_service_of_the_former_version_is_sent_all_files(serve: Callable[..., Front], tmp_path: Path) -> None:
    service = Datasets()
    (tmp_path / "a.obj").write_text("x")

    def answer(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        if method == "POST" and path.endswith("/files"):
            return as_json({"detail": "Method Not Allowed"}, 405)
        return service(method, path, headers, body)

    with Api(serve(answer).address) as api:
        notes: list[str] = []
        files = dict.fromkeys(("a.obj", "b.obj"), tmp_path / "a.obj")
        assert upload_files(api, files, on_note=notes.append)["state"] == "committed"
    assert service.uploads == 2 and notes == []


def test_busy_service_is_left_alone_for_as_long_as_it_asks(
    serve: Callable[..., Front], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(backoff.time, "sleep", pauses.append)
    monkeypatch.setattr("octasplat.workers.client.dataset_files.MIN_RESUMABLE_BYTES", 1)
    service, refusals = Datasets(), {"POST": 1, "PATCH": 1}
    (tmp_path / "a.obj").write_text("x")

    def answer(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        if "/uploads" not in path:
            task = {"id": "t", "dataset_id": "d0", "state": "succeeded", "problem": None}
            return as_json(task) if path.endswith("/t") else service(method, path, headers, body)
        if refusals.get(method):
            refusals[method] -= 1
            document = json.dumps({"detail": "Too many uploads are unfinished."}).encode()
            return 429, {"Retry-After": "30", "Content-Type": "application/problem+json"}, document
        if method == "POST":
            made = json.dumps({"size_bytes": 1, "offset_bytes": 0}).encode()
            return 201, {"Location": "/v1/datasets/d0/uploads/u"}, made
        told = {"Upload-Offset": "1", "Location": "/v1/datasets/d0/tasks/t"}
        return (200, {"Upload-Offset": "0"}, b"") if method == "HEAD" else (204, told, b"")

    with Api(serve(answer).address) as api:
        assert upload_files(api, {"a.obj": tmp_path / "a.obj"})["state"] == "committed"
    assert pauses == [30.0, 30.0]


@pytest.mark.parametrize("part_bytes", [0, 1])
def test_file_that_was_stored_before_the_answer_to_its_last_part_was_lost(
    serve: Callable[..., Front], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, part_bytes: int
) -> None:
    monkeypatch.setattr("octasplat.workers.client.dataset_files.MIN_RESUMABLE_BYTES", 1)
    service, is_stored = Datasets(), False
    (tmp_path / "a.obj").write_text("x")
    etag = f'"{hashlib.sha256(b"x").hexdigest()}"'

    def answer(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        nonlocal is_stored
        if method == "HEAD" and path.endswith("/files/a.obj"):
            return 200, {"ETag": etag}, b""
        if "/uploads" not in path:
            return service(method, path, headers, body)
        if method == "POST":
            made = {"size_bytes": 1, "offset_bytes": 0, "part_bytes": part_bytes}
            return 201, {"Location": "/v1/datasets/d0/uploads/u"}, json.dumps(made).encode()
        if is_stored:
            return as_json({"detail": "There is no such upload."}, 404)
        is_stored = method in ("PUT", "PATCH")
        return as_page(502) if is_stored else (200, {"Upload-Offset": "0"}, b"")

    front = serve(answer)
    with Api(front.address) as api:
        assert upload_files(api, {"a.obj": tmp_path / "a.obj"})["state"] == "committed"
    assert sum(asked.startswith(("PUT", "PATCH")) for asked in front.asked) == (2 if part_bytes else 1)


@pytest.mark.parametrize("state", ["succeeded", "failed"])
def test_archive_that_was_stored_after_its_sender_was_killed_is_not_sent_again(
    serve: Callable[..., Front], tmp_path: Path, state: str
) -> None:
    """But one that was refused is, as there may be room for it now."""
    (tmp_path / "a.zip").write_bytes(b"x")

    def answer(method: str, path: str, headers: dict[str, str], _body: bytes) -> Answer:
        if path.endswith("/tasks"):
            kinds = {"commit": "failed", "upload": state}
            return as_json({"tasks": [{"kind": k, "state": s} for k, s in kinds.items()], "next": None})
        if path.endswith("/t"):
            return as_json({"id": "t", "dataset_id": "d", "state": "succeeded", "problem": None})
        if method == "POST":
            if headers["Idempotency-Key"].endswith("-0"):
                return as_json({"detail": "There is no such upload."}, 404)
            made = {"size_bytes": 1, "offset_bytes": 0, "part_bytes": 1}
            return 201, {"Location": "/v1/datasets/d/uploads/u"}, json.dumps(made).encode()
        return 204, {"Location": "/v1/datasets/d/tasks/t"}, b""

    front = serve(answer)
    with Api(front.address) as api:
        send_resumable(api, "d", tmp_path / "a.zip", None, hashlib.sha256(b"x").hexdigest())
    assert sum(asked.startswith("PUT") for asked in front.asked) == (state == "failed")


@pytest.mark.parametrize("resumable_bytes", [8, 1 << 20])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda path: path.write_text("x"), "became shorter while it was sent"),
        (lambda path: path.write_text("x" * 100), None),
        (lambda path: path.unlink(), "cannot be read (No such file"),
    ],
)
def test_file_whose_length_changes_while_it_is_sent_is_told(
    serve: Callable[..., Front],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[Path], None],
    words: str | None,
    resumable_bytes: int,
) -> None:
    monkeypatch.setattr("octasplat.workers.client.dataset_files.MIN_RESUMABLE_BYTES", resumable_bytes)
    service, file, bodies = Datasets(), tmp_path / "a.obj", list[bytes]()
    file.write_text("y" * 50)
    open_file = Path.open

    def change_when_sent(path: Path, *arguments: Any, **named: Any) -> Any:
        opened.append(path)
        if len(opened) == 2:  # the first time is for the digest
            change(file)
        return open_file(path, *arguments, **named)

    def answer(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        if path.endswith("/t"):
            return as_json({"id": "t", "dataset_id": "d0", "state": "succeeded", "problem": None})
        if method == "POST" and path.endswith("/uploads"):
            made = {"size_bytes": 50, "offset_bytes": 0, "part_bytes": 50, "parts_ahead": []}
            return 201, {"Location": "/v1/datasets/d0/uploads/u"}, json.dumps(made).encode()
        if method != "PUT":
            return service(method, path, headers, body)
        bodies.append(body)
        return 204, {"Location": "/v1/datasets/d0/tasks/t"}, b""

    opened: list[Path] = []
    with Api(serve(answer).address) as api:
        monkeypatch.setattr(Path, "open", change_when_sent)
        if words is None:  # the service compares the digest
            upload_files(api, {"a.obj": file})
            assert [len(body) for body in bodies] == [50]
        else:
            with pytest.raises(DatasetError, match=re.escape(words)):
                upload_files(api, {"a.obj": file})


def test_large_and_small_files_share_four_connections(
    serve: Callable[..., Front], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("octasplat.workers.client.dataset_files.MIN_RESUMABLE_BYTES", 8)
    service, lock, now, most = Datasets(), threading.Lock(), [0], [0]
    files = {f"{number}.obj": tmp_path / f"{number}.obj" for number in range(8)}
    for number, path in enumerate(files.values()):
        path.write_text("x" * (8 if number % 2 else 1))

    def answer(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        if path.endswith("/t"):
            return as_json({"id": "t", "dataset_id": "d0", "state": "succeeded", "problem": None})
        if method == "POST" and path.endswith("/uploads"):
            made = {"size_bytes": 8, "offset_bytes": 0, "part_bytes": 1, "parts_ahead": [3]}
            return 201, {"Location": "/v1/datasets/d0/uploads/u"}, json.dumps(made).encode()
        if method != "PUT":
            return service(method, path, headers, body)
        with lock:
            now[0] += 1
            most[0] = max(most[0], now[0])
        time.sleep(0.02)
        with lock:
            now[0] -= 1
        return 204, {"Location": "/v1/datasets/d0/tasks/t"}, b""

    told: list[int] = []
    front = serve(answer)
    with Api(front.address) as api:
        assert upload_files(api, files, progress=lambda d, _t: told.append(d))["state"] == "committed"
    assert 1 < most[0] <= 4
    assert sum(asked.startswith("PUT") for asked in front.asked) == 4 + 4 * 7
    assert told[-1] == max(told) == 4 * 1 + 4 * 8


def test_large_file_is_not_sent_on_when_another_one_is_refused(
    serve: Callable[..., Front], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor when the program is interrupted; its user would wait for as long as the file takes."""
    monkeypatch.setattr("octasplat.workers.client.dataset_files.MIN_RESUMABLE_BYTES", 64)
    service, sent = Datasets(), threading.Event()
    files = {"a.obj": tmp_path / "a.obj", "b.obj": tmp_path / "b.obj"}
    for path, length in zip(files.values(), (64, 1), strict=True):
        path.write_text("x" * length)

    def answer(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        if method == "POST" and path.endswith("/uploads"):
            made = {"size_bytes": 64, "offset_bytes": 0, "part_bytes": 1, "parts_ahead": []}
            return 201, {"Location": "/v1/datasets/d0/uploads/u"}, json.dumps(made).encode()
        if method != "PUT":
            return service(method, path, headers, body)
        if path.endswith("/b.obj"):
            sent.wait(10)
            return as_json({"detail": "It is no mesh."}, 422)
        sent.set()
        time.sleep(0.05)
        return 204, {}, b""

    front = serve(answer)
    with Api(front.address) as api, pytest.raises(ServiceError, match="no mesh"):
        upload_files(api, files)
    assert sum("/parts/" in asked for asked in front.asked) < 32


def test_commit_after_interrupted_check_succeeds(serve: Callable[..., Front], tmp_path: Path) -> None:
    service = Datasets()
    service.refusals = 3
    (tmp_path / "a.obj").write_text("x")
    with Api(serve(service).address) as api:
        assert upload_files(api, {"a.obj": tmp_path / "a.obj"})["state"] == "committed"
        for dataset in service.made.values():
            assert dataset is not None
            dataset["state"] = "checking"  # by a front end that was killed
        assert upload_files(api, {"a.obj": tmp_path / "a.obj"})["state"] == "committed"


def test_delete_of_missing_file_succeeds(serve: Callable[..., Front], tmp_path: Path) -> None:
    """As when the service ended after it removed the file and before it said so."""
    (tmp_path / "a").write_bytes(b"x")
    there, removals = {"a", "b"}, [0]

    def answer(method: str, path: str, _headers: dict[str, str], _body: bytes) -> Answer:
        name = path.rpartition("/")[2]
        if method == "DELETE":
            removals[0] += 1
            if name in there:
                there.remove(name)
                return 503, {"Content-Type": "application/problem+json"}, b"{}"
            return as_json({"detail": "There is no such file."}, 404)
        if path.startswith("/v1/datasets/d/files?"):
            digest = hashlib.sha256(b"x").hexdigest()
            return as_json({"files": [{"path": n, "sha256": digest} for n in sorted(there)], "next": None})
        return as_json({"id": "d", "state": "committed" if path.endswith("/commit") else "open"})

    front = serve(answer)
    with Api(front.address) as api:
        assert upload_files(api, {"a": tmp_path / "a"})["state"] == "committed"
    assert removals == [2] and there == {"a"}


def test_refused_options_cost_no_upload(serve: Callable[..., Front], tmp_path: Path) -> None:
    asked: list[str] = []

    def service(_method: str, path: str, _headers: dict[str, str], _body: bytes) -> Answer:
        asked.append(path)
        return as_json({"detail": "There is no setting 'iteration'; the nearest is iterations."}, 422)

    (tmp_path / "a.obj").write_text("x")
    with Api(serve(service).address) as api:
        with pytest.raises(ServiceError, match="the nearest is iterations"):
            submit(api, Submission(tmp_path, {"iteration": 3}))
        with pytest.raises(ServiceError, match="the nearest is iterations"):
            derive(api, Derivation(None, "import", {"iteration": 3}, {"a.obj": tmp_path / "a.obj"}))
    assert asked == ["/v1/estimates"] * 2
