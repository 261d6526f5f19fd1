"""A lack of room ends renders alone whose own images cause it, and never because a worker stops."""

import asyncio
import dataclasses
import uuid
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.postgres_text import as_json
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from octasplat.workers.storage.disk_space import NO_USAGE, SpaceUsage
from octasplat.workers.storage.factory import open_storage
from octasplat.workers.storage.trees import TreeFile
from octasplat.workers.worker.admission import Admission
from octasplat.workers.worker.checkpoint import Checkpoint
from octasplat.workers.worker.job_kinds import get_job_kind
from tests.support.worker_harness import WorkerHarness

KEPT = Checkpoint(1, "render", 3, (TreeFile(path="run/frames/a.exr", sha256="0" * 64, size_bytes=1 << 20),))


@dataclasses.dataclass
class CrowdedWorker:
    """A worker on disks where any checkpoint takes the room that is lacking."""

    job_queue: ProcrastinateQueue
    storage: Any
    settings: SimpleNamespace
    draining: asyncio.Event

    async def space_shortage(self, excluding: SpaceUsage = NO_USAGE) -> str | None:
        return None if excluding.store_bytes else "The store lacks room."


@pytest.mark.parametrize(
    ("kind", "stops", "state"),
    [("render", False, "failed"), ("render", True, "queued"), ("reconstruct", False, "queued")],
)
def test_job_with_checkpoint_on_crowded_disk(
    bench: WorkerHarness, tmp_path: Path, kind: str, stops: bool, state: str
) -> None:
    given = {"format": "exr", "frames": 4} if kind == "render" else {}
    options = get_job_kind(kind).resolve(given).model_dump(mode="json")
    job_id = bench.submit(kind, options=options)
    assert asyncio.run(_admit(bench, tmp_path, job_id, stops)) is False
    job = bench.job(job_id)
    assert (job.state, job.checkpoint is None) == (state, state == "failed"), job.error


async def _admit(bench: WorkerHarness, folder: Path, job_id: uuid.UUID, stops: bool) -> bool:
    """Let a worker look at a job that has a checkpoint."""
    seconds = 60.0 if stops else 0.1
    settings = SimpleNamespace(full_disk_seconds=seconds, poll_seconds=0.05, work_folder=folder / "work")
    draining = asyncio.Event()
    if stops:
        draining.set()
    storage = open_storage(folder / "store", floor_bytes=0)
    async with open_pool(bench.conninfo, max_size=4) as pool:
        async with pool.connection() as connection, connection.transaction():
            await lock_owner(connection, "me")
            cursor = await connection.execute(
                "UPDATE jobs SET checkpoint = %s WHERE id = %s RETURNING slip",
                [as_json(KEPT.as_row()), job_id],
            )
            row = await cursor.fetchone()
        assert row is not None
        worker: Any = CrowdedWorker(ProcrastinateQueue(), storage, settings, draining)
        return await Admission("w", pool, worker).admit(job_id, row["slip"])
