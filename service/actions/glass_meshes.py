"""Refusal of stages with a mesh that is to be glass and is not closed, before the job is queued."""

import asyncio
import uuid
from collections.abc import Mapping
from weakref import WeakValueDictionary

from pydantic import BaseModel

from octasplat.service.auth import Principal
from octasplat.service.intake.mesh_check import find_open_glass
from octasplat.service.problems import MAX_ERRORS, ProblemError
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.db.datasets import files_of, get_dataset
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.storage.trees import TreeFile
from octasplat.workers.worker.job_kinds import JobKind

WAIT_SECONDS = 40.0
"""After which the job checks its meshes: an answer does not wait for many other checks."""
_CHECKS_OF_OWNERS: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()
"""Held by the one check of an owner that is under way, so that one owner does not take all threads."""


async def check_glass_meshes(
    service: Service, principal: Principal, kind: JobKind, options: BaseModel, files_id: uuid.UUID | None
) -> None:
    """Refuse options with a mesh of glass that is not closed, as far as that shows soon; else the job does.

    It reads files, which no transaction should wait for.

    Args:
        service: the service.
        principal: asks.
        kind: of the job.
        options: complete ones.
        files_id: the dataset that holds the files; others are refused elsewhere.

    Raises:
        ProblemError: 422, with the place of each such mesh.
    """
    meshes = kind.glass_meshes(options)
    if not meshes or files_id is None:
        return
    async with service.pool.connection() as connection:
        dataset = await get_dataset(connection, files_id)
        if dataset is None or not principal.may_see(dataset.owner) or dataset.state != "committed":
            return
        rows = await files_of(connection, files_id)
    files = [TreeFile(path=row.path, sha256=row.sha256, size_bytes=row.size_bytes) for row in rows]
    if not {mesh.file for mesh in meshes.values()} <= {file.path for file in files}:
        return
    turn = _CHECKS_OF_OWNERS.setdefault(principal.owner, asyncio.Lock())
    try:
        async with asyncio.timeout(WAIT_SECONDS):
            await turn.acquire()
            check = asyncio.ensure_future(
                run_in_pool(
                    ThreadPurpose.MESHES,
                    find_open_glass, service.storage, meshes, files, service.settings.mesh_limits(),
                )
            )  # fmt: skip
            # Not before, as its thread goes on where nobody waits for it any more.
            check.add_done_callback(lambda done: _end_turn(turn, done))
            faults = await asyncio.shield(check)
    except (OSError, StorageError):  # the limit of the time among them
        return
    errors = [
        {"pointer": f"#/options/stage/meshes/{number}/file", "detail": detail, "file": meshes[number].file}
        for number, detail in list(faults.items())[:MAX_ERRORS]
    ]
    if errors:
        raise ProblemError(422, "stage-mesh", str(errors[0]["detail"]), errors=errors)


def _end_turn(turn: asyncio.Lock, check: "asyncio.Future[Mapping[int, str]]") -> None:
    """Let the next check of an owner begin; errors of one that nobody waits for any more are passed over."""
    if not check.cancelled():
        check.exception()
    turn.release()
