"""Whatever some ask for, others are served meanwhile; what is too much is refused and can be repeated."""

import asyncio
import threading
from typing import Any

import httpx
import pytest

from octasplat.service.actions import datasets as actions
from octasplat.service.intake.dataset import DatasetSummary
from tests.support.service_harness import ConnectService

PATIENCE_SECONDS = 60.0


async def new_dataset(http: httpx.AsyncClient) -> str:
    return str((await http.post("/v1/datasets", json={"name": "d"})).headers["Location"])


@pytest.fixture
def slow_checks(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Checks of datasets that last until the event is set; says how many are under way at most."""
    most = {"now": 0, "most": 0, "release": threading.Event()}

    def check(*_: object) -> DatasetSummary:
        most["now"] += 1
        most["most"] = max(most["most"], most["now"])
        assert most["release"].wait(PATIENCE_SECONDS)
        most["now"] -= 1
        return DatasetSummary(photographs=3, pixels=1, size_bytes=1, masks=0, has_model=False)

    monkeypatch.setattr(actions, "check_dataset", check)
    return most


async def test_dataset_checks_do_not_block_other_requests(
    connect_service: ConnectService, slow_checks: Any
) -> None:
    async with asyncio.timeout(PATIENCE_SECONDS):
        async with connect_service(max_checks=2, max_waiting_checks=16) as (http, _):
            addresses = [await new_dataset(http) for _ in range(13)]
            commits = {asyncio.create_task(http.post(f"{address}/commit")) for address in addresses}
            while sum(task.done() for task in commits) < 4:  # nine of eighteen places are one owner's
                await asyncio.sleep(0.01)
            answers = [task.result() for task in commits if task.done()]
            assert {answer.status_code for answer in answers} == {429}
            assert answers[0].json()["type"] == "urn:octasplat:problem:busy"
            assert int(answers[0].headers["Retry-After"]) > 0
            other = await new_dataset(http)
            assert (await http.put(f"{other}/files/images/a.txt", content=b"x")).status_code == 422
            assert (await http.get("/readyz")).status_code == 200
            slow_checks["release"].set()
            done = [task.result().status_code for task in (await asyncio.wait(commits))[0]]
            assert sorted(done) == [200] * 9 + [429] * 4 and slow_checks["most"] == 2
