"""What a running service takes: jobs queued, listed and cancelled while listeners hear of it.

    octasplat serve --queues '' &
    python -m benchmarks.service_load --jobs 1000 --listeners 100

None of the jobs is begun where ``--queues ''`` leaves the work to nobody.
Prints JSON: seconds for each part, times of single answers in milliseconds, events that the listeners heard,
and memory of the front end before and after where it runs on this machine.
"""

import argparse
import asyncio
import contextlib
import json
import os
import statistics
import tempfile
import time
import uuid
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks.chaos import make_scene
from octasplat.workers.client.api import Api, find_address, find_token
from octasplat.workers.client.upload import upload_scene

TERMINAL = ('"state": "canceled"', '"state": "succeeded"', '"state": "failed"')


class Load:
    """A client of the service that keeps the times of its requests.

    Args:
        http: to the service.
        parallel: requests at once.
    """

    def __init__(self, http: httpx.AsyncClient, parallel: int) -> None:
        self._http = http
        self._turn = asyncio.Semaphore(parallel)
        self.milliseconds: list[float] = []
        self.events = 0
        self.ended = 0
        self.put_off = 0
        """How often an answer asked for patience, or did not come."""

    async def ask(self, method: str, path: str, **arguments: Any) -> Any:
        """The JSON of an answer; one that asks for patience is asked for again when it says."""
        if method == "POST":  # a connection may end before its answer has come
            arguments["headers"] = {"Idempotency-Key": str(uuid.uuid4())}
        async with self._turn:
            while True:
                began = time.perf_counter()
                try:
                    response = await self._http.request(method, path, **arguments)
                except httpx.TransportError:
                    self.put_off += 1
                    await asyncio.sleep(1)
                    continue
                self.milliseconds.append(1000 * (time.perf_counter() - began))
                if response.status_code not in (429, 503):
                    break
                self.put_off += 1
                await asyncio.sleep(float(response.headers["Retry-After"]))
        response.raise_for_status()
        return response.json()

    async def listen(self, job_id: str, ready: asyncio.Event) -> None:
        """Hear the events of a job until it is over."""
        async with self._http.stream("GET", f"/v1/jobs/{job_id}/events", timeout=None) as response:
            response.raise_for_status()
            async for line in response.aiter_lines():
                ready.set()
                if line.startswith("data:"):
                    self.events += 1
                    if any(state in line for state in TERMINAL):
                        self.ended += 1

    async def part(self, name: str, work: Any) -> dict[str, float]:
        """Do something and say how long it took."""
        self.milliseconds.clear()
        began = time.perf_counter()
        await work
        seconds = time.perf_counter() - began
        times = sorted(self.milliseconds) or [0.0]
        return {
            f"{name}_seconds": round(seconds, 2),
            f"{name}_requests": len(times),
            f"{name}_median_ms": round(statistics.median(times), 1),
            f"{name}_p99_ms": round(times[int(0.99 * (len(times) - 1))], 1),
        }


async def measure(
    address: str, token: str | None, dataset: str, options: argparse.Namespace
) -> dict[str, Any]:
    """Queue, listen, list, cancel."""
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    limits = httpx.Limits(max_connections=None)
    async with httpx.AsyncClient(base_url=address, headers=headers, timeout=120, limits=limits) as http:
        load = Load(http, options.parallel)
        before = front_end_memory(address)
        ids: list[str] = []
        body = {"dataset_id": dataset, "options": {"preset": "fast"}}

        async def queue(number: int) -> None:
            ids.append((await load.ask("POST", "/v1/jobs", json={**body, "label": f"load {number}"}))["id"])

        async def list_all() -> None:
            cursor: dict[str, Any] = {}
            seen: set[str] = set()
            while True:
                page = await load.ask("GET", "/v1/jobs", params={"limit": 200, "state": "queued", **cursor})
                seen |= {job["id"] for job in page["jobs"]}
                if page["next"] is None:
                    break
                cursor = {"cursor": page["next"]}
            assert set(ids) <= seen, "jobs are missing from the list"

        async def cancel(job_id: str) -> None:
            job = await load.ask("POST", f"/v1/jobs/{job_id}/cancel")
            assert job["state"] in ("canceled", "canceling"), job

        found = await load.part("queue", asyncio.gather(*(queue(number) for number in range(options.jobs))))
        ready = [asyncio.Event() for _ in range(options.listeners)]
        listeners = [
            asyncio.create_task(load.listen(ids[number % len(ids)], ready[number]))
            for number in range(options.listeners)
        ]
        found |= await load.part("listeners_ready", asyncio.gather(*(event.wait() for event in ready)))
        found |= await load.part("list", list_all())
        found |= await load.part("cancel", asyncio.gather(*(cancel(job_id) for job_id in ids)))
        cancelled = time.perf_counter()
        await asyncio.wait_for(asyncio.gather(*listeners), 60)
        found["last_listener_after_seconds"] = round(time.perf_counter() - cancelled, 2)
        after = front_end_memory(address)
    memory = {} if before is None or after is None else {"front_end_mb": before, "front_end_mb_after": after}
    return {
        "jobs": options.jobs, "listeners": options.listeners, "parallel": options.parallel, **found,
        "events_heard": load.events, "listeners_told_of_the_end": load.ended, **memory,
        "load_average": round(os.getloadavg()[0], 1), "cores": os.cpu_count(),
    }  # fmt: skip


def front_end_memory(address: str) -> float | None:
    """Memory of the process that listens at the address, in MB, where it is on this machine."""
    port = httpx.URL(address).port
    with contextlib.suppress(psutil.Error):
        for connection in psutil.net_connections("tcp"):
            listens = connection.status == psutil.CONN_LISTEN and connection.laddr.port == port
            if listens and connection.pid:
                return round(psutil.Process(connection.pid).memory_info().rss / 1e6, 1)
    return None


def main() -> None:
    """Measure a running service."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--listeners", type=int, default=100)
    parser.add_argument("--parallel", type=int, default=8, help="requests at once")
    options = parser.parse_args()
    address = find_address(os.environ)
    token = find_token(os.environ, address)
    with tempfile.TemporaryDirectory() as folder, Api(address, token) as api:
        dataset = upload_scene(api, make_scene(Path(folder) / "scene"))["id"]
    print(json.dumps(asyncio.run(measure(address, token, dataset, options)), indent=1))


if __name__ == "__main__":
    main()
