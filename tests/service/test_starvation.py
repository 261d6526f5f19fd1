"""Whatever some ask for, others are served meanwhile; what is too much is refused and can be repeated."""

import asyncio
import contextlib
import threading
from typing import Any

import httpx
import pytest

from octasplat.service.actions import commits as actions
from octasplat.service.intake.dataset import DatasetSummary
from octasplat.service.state import Service
from octasplat.workers.db.dataset_tasks import count_unfinished
from tests.support.service_harness import ConnectService, client_with_token, new_job

PATIENCE_SECONDS = 60.0
STREAM_LOOK_SECONDS = 5.0
"""A stream looks at the database at least so often."""


async def new_dataset(http: httpx.AsyncClient) -> str:
    return str((await http.post("/v1/datasets", json={"name": "d"})).headers["Location"])


async def wait_for_commits(service: Service, count: int) -> None:
    """Until so many commits wait or are worked on."""
    while True:
        async with service.pool.connection() as connection:
            if (await count_unfinished(connection, "", "commit")).of_all == count:
                return
        await asyncio.sleep(0.02)


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


async def test_event_stream_outlives_a_want_of_connections(connect_service: ConnectService) -> None:
    async with asyncio.timeout(PATIENCE_SECONDS), connect_service() as (http, service):
        job = await new_job(http, service)
        stream = asyncio.create_task(http.get(f"/v1/jobs/{job['id']}/events"))
        while service.event_broker.subscriber_count == 0:
            await asyncio.sleep(0.01)
        usual, service.pool.timeout = service.pool.timeout, 0.2
        async with contextlib.AsyncExitStack() as taken:
            for _ in range(service.pool.max_size):
                await taken.enter_async_context(service.pool.connection(timeout=PATIENCE_SECONDS))
            await asyncio.sleep(2 * STREAM_LOOK_SECONDS)
            assert not stream.done()
        service.pool.timeout = usual
        assert (await http.post(f"/v1/jobs/{job['id']}/cancel")).is_success
        answer = await stream
        assert answer.status_code == 200 and '"canceled"' in answer.text


async def test_commits_of_one_owner_take_turns_with_those_of_others(
    connect_service: ConnectService, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One place, ten commits of one owner, then one of another: it is the next, not the eleventh."""
    places = threading.Semaphore(0)

    def check(*_: object) -> DatasetSummary:
        assert places.acquire(timeout=PATIENCE_SECONDS)
        return DatasetSummary(photographs=3, pixels=1, size_bytes=1, masks=0, has_model=False)

    monkeypatch.setattr(actions, "check_dataset", check)
    async with asyncio.timeout(PATIENCE_SECONDS):
        async with connect_service(max_checks=1, max_waiting_checks=20) as (http, service):
            bob = await client_with_token(service, "bob", "write")
            mine = [await new_dataset(http) for _ in range(10)]
            other = (await http.post("/v1/datasets", json={"name": "d"}, headers=bob)).headers["Location"]
            commits = [asyncio.create_task(http.post(f"{address}/commit")) for address in mine]
            await wait_for_commits(service, len(mine))
            quick = asyncio.create_task(http.post(f"{other}/commit", headers=bob))
            await wait_for_commits(service, len(mine) + 1)
            places.release()
            places.release()
            assert (await quick).status_code == 200
            assert sum(task.done() for task in commits) <= 1
            for _ in mine:
                places.release()
            assert {answer.status_code for answer in await asyncio.gather(*commits)} == {200}


async def test_streams_of_one_address_leave_room_for_others(connect_service: ConnectService) -> None:
    """Whatever owners they are of; the one address of a proxy that is named counts as those behind it."""
    settings = {"max_streams": 10, "max_streams_per_owner": 2, "max_streams_per_address": 3}
    async with connect_service(**settings, proxies=("127.0.0.1",)) as (http, service):
        bob = await client_with_token(service, "bob", "admin")
        address = f"/v1/jobs/{(await new_job(http, service))['id']}/events"
        here, elsewhere = {"X-Forwarded-For": "2001:db8::1"}, {"X-Forwarded-For": "192.0.2.1"}
        asked = [here, here, {**bob, "X-Forwarded-For": "2001:db8::2"}]
        streams = [asyncio.create_task(http.get(address, headers=headers)) for headers in asked]
        try:
            while service.event_broker.subscriber_count < 3:
                await asyncio.sleep(0.01)
            refused = await http.get(address, headers={**bob, **here})
            assert refused.status_code == 429 and "address" in refused.json()["detail"]
            streams.append(asyncio.create_task(http.get(address, headers={**bob, **elsewhere})))
            while service.event_broker.subscriber_count < 4:
                await asyncio.sleep(0.01)
        finally:
            service.event_broker.close()
            await asyncio.gather(*streams)


async def test_streams_of_one_owner_leave_room_for_others(connect_service: ConnectService) -> None:
    async with connect_service(max_streams=10, max_streams_per_owner=3) as (http, service):
        bob = await client_with_token(service, "bob", "admin")
        address = f"/v1/jobs/{(await new_job(http, service))['id']}/events"
        streams = [asyncio.create_task(http.get(address)) for _ in range(3)]
        try:
            while service.event_broker.subscriber_count < 3:
                await asyncio.sleep(0.01)
            refused = await http.get(address)
            assert refused.status_code == 429
            assert refused.json()["type"] == "urn:octasplat:problem:streams"
            streams.append(asyncio.create_task(http.get(address, headers=bob)))
            while service.event_broker.subscriber_count < 4:
                await asyncio.sleep(0.01)
        finally:
            service.event_broker.close()
            await asyncio.gather(*streams)
