"""All that a service is asked for at once: a long queue, many workers, many listeners and one huge upload.

    python -m benchmarks.service_crowd --jobs 2000 --workers 20 --streams 500 --upload-gib 10

Prints JSON: seconds of each part, answers of ``/healthz`` in milliseconds while all of it goes on, the
largest memory of the front end, and how much the workers did meanwhile. Jobs are those of
:mod:`benchmarks.chaos_kind`, of one step each. The upload is a ZIP file of photographs that are all equal, so
that the store keeps one of them; what is measured is the way there.
"""

import argparse
import asyncio
import contextlib
import io
import json
import os
import tempfile
import time
import zipfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from PIL import Image

from benchmarks.chaos import make_scene
from benchmarks.chaos_machine import ROOT
from benchmarks.fleet import Fleet
from benchmarks.service_load import Load, front_end_memory
from octasplat.workers.client.api import Api
from octasplat.workers.client.upload import upload_scene
from octasplat.workers.settings import WorkerSettings

STREAMS_PER_OWNER = 50
PHOTOGRAPH_SIDE_PX = 3200
HEALTH_SECONDS = 0.05
SETTINGS = {
    "MAX_STREAMS_PER_ADDRESS": "10000",
    **{
        f"{name.upper()}_SECONDS": str(WorkerSettings.model_fields[f"{name}_seconds"].default)
        for name in ("heartbeat", "stale", "rescue", "poll")
    },
}
"""Times that users get; all listeners have one address here."""
LOW_PRIORITY = ("sh", "-c", 'echo 9 > /proc/self/autogroup; exec nice -n 9 "$@"', "sh")
"""Prefix of a worker's command: on hosts of their own they would take no core from the front end.

Between sessions Linux compares the niceness of these groups alone. Jobs have the lowest priority then.
"""


class _Chunks(io.RawIOBase):
    """A file to write to, whose content is taken out as it comes."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self._parts.append(bytes(data))
        self._length += len(data)
        return len(data)

    def tell(self) -> int:
        return self._length

    def take(self) -> bytes:
        """Return what was written since the last call."""
        taken, self._parts = b"".join(self._parts), []
        return taken


def archive_chunks(size_bytes: int) -> Iterator[bytes]:
    """Yield a ZIP file of about this size in chunks: one photograph of noise under many names."""
    noise = np.random.default_rng(0).integers(0, 256, (PHOTOGRAPH_SIDE_PX, PHOTOGRAPH_SIDE_PX, 3), np.uint8)
    memory = io.BytesIO()
    Image.fromarray(noise).save(memory, "PNG", compress_level=0)
    photograph = memory.getvalue()
    chunks = _Chunks()
    with zipfile.ZipFile(chunks, "w", zipfile.ZIP_STORED) as archive:
        for number in range(max(1, size_bytes // len(photograph))):
            with archive.open(f"images/{number:05d}.png", "w") as member:
                for start in range(0, len(photograph), 1 << 20):
                    member.write(photograph[start : start + (1 << 20)])
                    yield chunks.take()
    yield chunks.take()


async def watch_health(http: httpx.AsyncClient, address: str, found: dict[str, Any]) -> None:
    """Ask ``/healthz`` again and again, and look at the front end's memory, until cancelled."""
    times: list[float] = []
    largest, failed = 0.0, 0
    try:
        while True:
            began = time.perf_counter()
            try:
                (await http.get("/healthz")).raise_for_status()
            except httpx.TransportError:  # the connection was kept for too long
                failed += 1
                continue
            times.append(1000 * (time.perf_counter() - began))
            if len(times) % 20 == 1:
                largest = max(largest, front_end_memory(address) or 0.0)
            await asyncio.sleep(HEALTH_SECONDS)
    finally:
        ordered = sorted(times)
        found.update(
            healthz_answers=len(times),
            healthz_lost=failed,
            healthz_median_ms=round(ordered[len(ordered) // 2], 1),
            healthz_p99_ms=round(ordered[int(0.99 * (len(ordered) - 1))], 1),
            healthz_slowest_ms=round(ordered[-1], 1),
            front_end_mb_at_most=largest,
        )


async def supervise(fleet: Fleet, found: dict[str, Any]) -> None:
    """Start workers again that end because they lost the database, until cancelled."""
    found["workers_restarted"] = 0
    while True:
        await asyncio.sleep(2)
        found["workers_restarted"] += len(fleet.revive())


async def upload(http: httpx.AsyncClient, size_bytes: int, found: dict[str, Any]) -> None:
    """Send the huge archive."""

    async def content() -> AsyncIterator[bytes]:
        for chunk in archive_chunks(size_bytes):
            yield chunk

    made = (await http.post("/v1/datasets", json={})).raise_for_status()
    dataset = made.json()
    began = time.perf_counter()
    answer = await http.put(
        f"/v1/datasets/{dataset['id']}/archive",
        content=content(),
        headers={"Content-Type": "application/zip"},
        timeout=None,
    )
    answer.raise_for_status()
    found["upload_seconds"] = round(time.perf_counter() - began, 1)
    found["upload_files"] = len(answer.json()["files"])


async def crowd(
    fleet: Fleet, tokens: list[str], datasets: list[str], options: argparse.Namespace
) -> dict[str, Any]:
    """Queue, listen and upload at once; say how it went."""
    found: dict[str, Any] = {}
    limits = httpx.Limits(max_connections=None)
    async with contextlib.AsyncExitStack() as stack:
        clients = [
            await stack.enter_async_context(
                httpx.AsyncClient(
                    base_url=fleet.address, headers={"Authorization": f"Bearer {token}"},
                    timeout=120, limits=limits,
                )
            )
            for token in tokens
        ]  # fmt: skip
        plain = await stack.enter_async_context(httpx.AsyncClient(base_url=fleet.address, timeout=120))
        loads = [Load(client, 4) for client in clients]
        found["front_end_mb_before"] = front_end_memory(fleet.address)
        watching = asyncio.create_task(watch_health(plain, fleet.address, found))
        supervising = asyncio.create_task(supervise(fleet, found))
        sending = asyncio.create_task(upload(clients[0], options.upload_gib << 30, found))
        ids: list[list[str]] = [[] for _ in loads]

        async def queue(number: int) -> None:
            owner = number % len(loads)
            chain = {"seed": number, "steps": 1, "seconds": 0}
            body = {"kind": "chain", "dataset_id": datasets[owner], "options": chain}
            ids[owner].append((await loads[owner].ask("POST", "/v1/jobs", json=body))["id"])

        began = time.perf_counter()
        await asyncio.gather(*(queue(number) for number in range(options.jobs)))
        found["slowest_submission_ms"] = round(max(value for load in loads for value in load.milliseconds), 1)
        found["submissions_put_off"] = sum(load.put_off for load in loads)
        found["queue_seconds"] = round(time.perf_counter() - began, 1)
        ready = [asyncio.Event() for _ in range(options.streams)]
        began = time.perf_counter()
        listeners = [
            asyncio.create_task(loads[k % len(loads)].listen(ids[k % len(loads)][-1 - k // len(loads)], done))
            for k, done in enumerate(ready)
        ]
        all_ready = asyncio.gather(*(event.wait() for event in ready))
        while not all_ready.done():
            waiting = [listener for listener in listeners if not listener.done()]
            done, _ = await asyncio.wait([all_ready, *waiting], return_when=asyncio.FIRST_COMPLETED)
            for ended in done:
                ended.result()  # the failure of a listener ends the run
        found["streams_ready_seconds"] = round(time.perf_counter() - began, 1)
        await sending
        await asyncio.sleep(options.seconds)
        states: dict[str, int] = {}
        for load in loads:
            for state in ("queued", "running", "succeeded", "failed"):
                page = await load.ask("GET", "/v1/jobs", params={"state": state, "limit": 200})
                states[state] = states.get(state, 0) + len(page["jobs"])
        found["states_at_the_end"] = states
        began = time.perf_counter()
        turns = asyncio.Semaphore(40)

        async def cancel(client: httpx.AsyncClient, job: str) -> None:
            async with turns:
                answer = await client.post(f"/v1/jobs/{job}/cancel")
            if answer.status_code != 409:  # it is over
                answer.raise_for_status()

        await asyncio.gather(
            *(cancel(client, job) for client, own in zip(clients, ids, strict=True) for job in own)
        )
        found["cancel_seconds"] = round(time.perf_counter() - began, 1)
        await asyncio.wait_for(asyncio.gather(*listeners), 300)
        for task in (watching, supervising):
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        found["events_heard"] = sum(load.events for load in loads)
        found["streams_told_of_the_end"] = sum(load.ended for load in loads)
    return found


def main() -> None:
    """Run the crowd against a service of its own."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--jobs", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=20)
    parser.add_argument("--streams", type=int, default=500)
    parser.add_argument("--upload-gib", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=60.0, help="to go on once the upload is there")
    options = parser.parse_args()
    owners = max(1, -(-options.streams // STREAMS_PER_OWNER))
    with tempfile.TemporaryDirectory(prefix="octasplat-crowd-") as name:
        Path(name).chmod(0o711)  # the database runs as a user of its own
        data = Path(name) / "data"
        data.mkdir()
        roots = {"front": ROOT} | {f"w{k:02d}": ROOT for k in range(options.workers)}
        fleet = Fleet(data, roots, worker_prefix=LOW_PRIORITY, settings=SETTINGS)
        fleet.begin()
        try:
            tokens = [
                fleet.command("token", "create", f"owner{k}", "--scope", "write") for k in range(owners)
            ]
            scene, datasets = make_scene(Path(name) / "scene"), []
            for token in tokens:
                with Api(fleet.address, token) as api:
                    datasets.append(upload_scene(api, scene)["id"])
            found = asyncio.run(crowd(fleet, tokens, datasets, options))
        finally:
            fleet.end()
    told = {name: getattr(options, name) for name in ("jobs", "workers", "streams", "upload_gib")}
    print(json.dumps({**told, **found, "cores": os.cpu_count()}, indent=1))


if __name__ == "__main__":
    main()
