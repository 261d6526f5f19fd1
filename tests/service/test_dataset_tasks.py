"""Commits and imports go on without the request that began them, and without the front end that took them."""

import asyncio
import threading
import uuid
from collections.abc import Callable
from typing import Any

import httpx
import psycopg
import pytest

from octasplat.service.actions import commits, task_runner
from octasplat.service.intake.dataset import DatasetSummary
from octasplat.service.intake.faults import IntakeError, IntakeFault
from octasplat.service.routes.preferences import seconds_to_wait
from octasplat.workers.db import dataset_tasks as rows
from octasplat.workers.db.dataset_checks import begin_check, end_check, reopen_stale_checks
from tests.support.service_harness import ConnectService, task_over

PATIENCE_SECONDS = 60.0
SUMMARY = DatasetSummary(photographs=3, pixels=1, size_bytes=1, masks=0, has_model=False)
AT_ONCE = {"Prefer": "respond-async"}


async def new_dataset(http: httpx.AsyncClient) -> str:
    return str((await http.post("/v1/datasets", json={"name": "d"})).headers["Location"])


class SlowCheck:
    """A check of datasets that lasts until it is let go, and can be told to find a fault."""

    def __init__(self) -> None:
        self.go_on = threading.Event()
        self.begun = 0
        self.error: Exception | None = None

    def __call__(self, *_: object) -> DatasetSummary:
        self.begun += 1
        assert self.go_on.wait(PATIENCE_SECONDS)
        if self.error is not None:
            raise self.error
        return SUMMARY


@pytest.fixture
def check(monkeypatch: pytest.MonkeyPatch) -> SlowCheck:
    slow = SlowCheck()
    monkeypatch.setattr(commits, "check_dataset", slow)
    return slow


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_SECONDS):
        while not condition():
            await asyncio.sleep(0.02)


async def test_commit_that_takes_long_is_answered_before_its_end(
    connect_service: ConnectService, check: SlowCheck
) -> None:
    async with connect_service(commit_wait_seconds=0.2) as (http, _):
        dataset = await new_dataset(http)
        answer = await http.post(f"{dataset}/commit")
        assert answer.status_code == 202 and int(answer.headers["Retry-After"]) > 0
        await until(lambda: check.begun == 1)
        task = (await http.get(answer.headers["Location"])).json()
        assert (task["kind"], task["state"], task["problem"]) == ("commit", "running", None)
        assert (await http.get(dataset)).json()["state"] == "checking"
        assert (await http.put(f"{dataset}/files/images/a.png", content=b"x")).status_code == 409
        again = await http.post(f"{dataset}/commit", headers=AT_ONCE)
        assert again.status_code == 202 and again.headers["Location"] == answer.headers["Location"]
        waiting = asyncio.create_task(http.post(f"{dataset}/commit", headers={"Prefer": "wait=30"}))
        check.go_on.set()
        whole = await waiting
        assert whole.status_code == 200 and whole.json()["state"] == "committed"
        assert (await task_over(http, answer))["state"] == "succeeded"
        assert (await http.post(f"{dataset}/commit", headers=AT_ONCE)).status_code == 200
        listed = (await http.get(f"{dataset}/tasks")).json()["tasks"]
        assert [entry["id"] for entry in listed] == [task["id"]] and check.begun == 1


async def test_faults_are_told_by_the_task_and_the_dataset_is_open_again(
    connect_service: ConnectService, check: SlowCheck
) -> None:
    check.error = IntakeError(IntakeFault("model-damaged", "The model is cut short.", "sparse/0/images.bin"))
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        answer = await http.post(f"{dataset}/commit", headers=AT_ONCE)
        waiting = asyncio.create_task(http.post(f"{dataset}/commit"))
        await until(lambda: check.begun == 1)
        check.go_on.set()
        task = await task_over(http, answer)
        told = await waiting
        assert told.status_code == task["problem"]["status"] == 422
        assert task["state"] == "failed"
        for problem in (told.json(), task["problem"]):
            assert (
                problem["type"].endswith(":model-damaged") and problem["detail"] == "The model is cut short."
            )
            assert [fault["file"] for fault in problem["errors"]] == ["sparse/0/images.bin"]
        assert (await http.get(dataset)).json()["state"] == "open"
        check.error = RuntimeError("a fault of the service")
        assert (await http.post(f"{dataset}/commit")).status_code == 500
        assert (await http.get(dataset)).json()["state"] == "open"
        check.error = None
        assert (await http.post(f"{dataset}/commit")).status_code == 200 and check.begun == 3


async def test_commit_goes_on_at_the_next_front_end(
    connect_service: ConnectService, check: SlowCheck
) -> None:
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        answer = await http.post(f"{dataset}/commit", headers=AT_ONCE)
        await until(lambda: check.begun == 1)
    check.go_on.set()
    async with connect_service(has_token=False) as (http, service):
        assert (await task_over(http, answer))["state"] == "succeeded"
        async with service.pool.connection() as connection:
            cursor = await connection.execute("SELECT attempt FROM dataset_tasks")
            assert await cursor.fetchone() == {"attempt": 1}  # who hands back does not count
    assert check.begun == 2


async def test_front_end_that_is_about_to_stop_begins_no_tasks(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(task_runner, "POLL_SECONDS", 0.02)
    async with connect_service() as (http, service):
        dataset = await new_dataset(http)
        service.is_draining = True
        await asyncio.sleep(0.5)  # a claim that was under way has ended
        async with service.pool.connection() as connection:
            task = await rows.add_task(connection, uuid.UUID(dataset.rpartition("/")[2]), "local", "commit")
        await asyncio.sleep(0.5)
        answer = httpx.Response(202, headers={"Location": f"{dataset}/tasks/{task.id}"})
        assert (await http.get(answer.headers["Location"])).json()["state"] == "queued"
    async with connect_service(has_token=False) as (http, _):
        problem = (await task_over(http, answer))["problem"]
        assert problem["type"] == "urn:octasplat:problem:dataset-photographs"


async def test_check_that_begins_beside_an_announcement_keeps_its_dataset(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(task_runner, "KEEP_ANNOUNCED_SECONDS", 1e6)
    async with connect_service() as (http, service):
        service.is_draining = True
        dataset = uuid.UUID((await new_dataset(http)).rpartition("/")[2])
        async with service.pool.connection() as connection:
            await rows.add_task(connection, dataset, "local", "commit")
            await connection.execute(
                "UPDATE datasets SET state = 'checking', used_at = now() - interval '30 s'"
            )
        async with service.pool.connection() as other, service.pool.connection() as ours:
            async with ours.transaction():
                assert await rows.claim_task(ours, "commit", max_per_owner=1) is not None
                check = await begin_check(ours, dataset)
                # It has seen the task while it was still queued, and waits for the row of the dataset.
                announcing = asyncio.create_task(rows.keep_announced_checks(other))
                await asyncio.sleep(0.3)
                assert not announcing.done()
            await announcing
            await other.commit()
            assert (await end_check(ours, check, is_valid=True)).state == "committed"


async def _kill(*_: object) -> None:
    raise psycopg.OperationalError("the process is gone")


async def test_commit_of_a_lost_front_end_is_taken_up_and_given_up_in_the_end(
    connect_service: ConnectService, check: SlowCheck, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rows, "LOST_SECONDS", 0.5)
    monkeypatch.setattr(task_runner, "RENEW_SECONDS", 0.2)
    answers = {}
    with monkeypatch.context() as patch:
        patch.setattr(rows, "hand_back_task", _kill)
        for life in range(rows.MAX_ATTEMPTS):
            async with connect_service(has_token=life == 0) as (http, service):
                if life < 2:
                    answers[life] = await http.post(f"{await new_dataset(http)}/commit", headers=AT_ONCE)
                await until(lambda life=life: check.begun >= (1, 3, 5)[life])  # type: ignore[misc]
                async with service.pool.connection() as connection:
                    await connection.execute("UPDATE datasets SET used_at = now() - interval '1 hour'")
                    assert await reopen_stale_checks(connection) == 0
    check.go_on.set()
    async with connect_service(has_token=False) as (http, _):
        assert (await task_over(http, answers[1]))["state"] == "succeeded"
        lost = await task_over(http, answers[0])
        assert (lost["state"], lost["problem"]["type"]) == ("failed", "urn:octasplat:problem:task-lost")


async def test_import_is_taken_up_by_the_next_front_end_and_forgets_its_address(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    go_on = asyncio.Event()

    async def fetch(_service: Any, task: rows.DatasetTask) -> Any:
        asked.append(task.request["url"])
        await go_on.wait()
        return task_runner.TaskOutcome({"files": 1, "left_out": [], "notes": []})

    monkeypatch.setattr(task_runner, "run_import", fetch)
    url = "https://example.org/a.zip?signature=secret"
    async with connect_service() as (http, _):
        dataset = await new_dataset(http)
        key = {"Idempotency-Key": "one"}
        answer = await http.post(f"{dataset}/import", json={"url": url}, headers=key)
        assert answer.status_code == 202 and url not in answer.text
        again = await http.post(f"{dataset}/import", json={"url": url}, headers=key)
        assert again.headers["Location"] == answer.headers["Location"]
        await until(lambda: len(asked) == 1)
        refused = await http.post(f"{dataset}/commit")
        assert refused.status_code == 409 and "1 imports or uploads" in refused.json()["detail"]
    go_on.set()
    async with connect_service(has_token=False) as (http, service):
        assert (await task_over(http, answer))["state"] == "succeeded" and asked == [url, url]
        async with service.pool.connection() as connection:
            cursor = await connection.execute("SELECT request FROM dataset_tasks")
            assert await cursor.fetchall() == [{"request": {}}]


async def test_import_ends_when_its_dataset_is_deleted(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, ended = asyncio.Event(), asyncio.Event()

    async def fetch(*_: object) -> Any:
        begun.set()
        try:
            await asyncio.sleep(PATIENCE_SECONDS)
        finally:
            ended.set()

    monkeypatch.setattr(task_runner, "run_import", fetch)
    monkeypatch.setattr(task_runner, "RENEW_SECONDS", 0.1)
    async with asyncio.timeout(PATIENCE_SECONDS / 2), connect_service() as (http, _):
        dataset = await new_dataset(http)
        await http.post(f"{dataset}/import", json={"url": "https://example.org/a.zip"})
        await begun.wait()
        assert (await http.delete(dataset)).status_code == 204
        await ended.wait()


@pytest.mark.parametrize(
    ("prefer", "seconds"),
    [
        (None, 20.0), ("", 20.0), ("return=minimal", 20.0), ("respond-async", 0.0),
        ("Respond-Async, wait=7", 7.0),
        ("wait=3;x=1", 3.0), ("wait=100000", 50.0), ("wait=-1", 20.0), ("wait=x", 20.0),
    ],
)  # fmt: skip
def test_prefer_says_how_long_an_answer_waits(prefer: str | None, seconds: float) -> None:
    assert seconds_to_wait(prefer, 20.0) == seconds


async def test_front_ends_that_claim_at_once_keep_the_share_of_an_owner(
    connect_service: ConnectService,
) -> None:
    async with connect_service() as (http, service):
        service.is_draining = True
        for _ in range(2):
            dataset = uuid.UUID((await new_dataset(http)).rpartition("/")[2])
            async with service.pool.connection() as connection:
                await rows.add_task(connection, dataset, "local", "commit")
        async with service.pool.connection() as first, service.pool.connection() as second:
            async with first.transaction():
                assert await rows.claim_task(first, "commit", max_per_owner=1) is not None
                claiming = asyncio.create_task(rows.claim_task(second, "commit", max_per_owner=1))
                await asyncio.sleep(0.3)
            assert await claiming is None
            assert await rows.claim_task(second, "commit", max_per_owner=2) is not None
