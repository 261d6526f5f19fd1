"""Results of jobs, and previews of running ones."""

import asyncio
import uuid

from octasplat.service.actions.access import check_searchable_name, fetch_visible_job, read_job
from octasplat.service.auth import Principal
from octasplat.service.live_scene_file import build_live_scene
from octasplat.service.problems import not_found_error
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.db.live_scenes import ShownScene, get_shown_scene
from octasplat.workers.db.rows import Artifact, Job
from octasplat.workers.queue import jobs as rows
from octasplat.workers.storage.protocol import Blob, Storage

_PARALLEL_LOOKS = 4
"""Results that are looked up at once for one request; others need threads too."""


async def list_artifacts(service: Service, principal: Principal, job_id: uuid.UUID) -> list[Artifact]:
    """Return the results of a job.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_job(connection, principal, job_id)
        return await rows.artifacts_of(connection, job_id)


async def get_job_with_artifacts(
    service: Service, principal: Principal, job_id: uuid.UUID
) -> tuple[Job, list[Artifact]]:
    """Return a job and its results, of which there is one at least.

    Raises:
        ProblemError: 404 if it does not exist, has no results, or the principal may not see it.
        StorageError: the store does not have a result.
    """
    async with service.pool.connection() as connection:
        job = await fetch_visible_job(connection, principal, job_id)
        found = await rows.artifacts_of(connection, job_id)
    if not found:
        raise not_found_error("result")
    # Before the answer begins, as nothing can be told from within a ZIP file.
    await _check_stored(service.storage, {row.sha256 for row in found})
    return job, found


async def _check_stored(storage: Storage, contents: set[str]) -> None:
    """Look up contents, some at once, as there may be thousands and a bucket takes a while for each.

    Raises:
        StorageError: the store does not have one.
    """
    left = iter(contents)  # all take from the same

    def look_up() -> None:
        for sha256 in left:
            storage.stat(sha256)

    looks = [run_in_pool(ThreadPurpose.DOWNLOADS, look_up) for _ in range(_PARALLEL_LOOKS)]
    for result in await asyncio.gather(*looks, return_exceptions=True):
        if result is not None:
            raise result


async def get_artifact(
    service: Service, principal: Principal, job_id: uuid.UUID, name: str, *, kind: str = "result"
) -> Artifact:
    """Return a result of a job; without one the problem says that there is no such ``kind``.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_job(connection, principal, job_id)
        row = await rows.get_artifact(connection, job_id, check_searchable_name(name, kind))
    if row is None:
        raise not_found_error(kind)
    return row


async def get_preview(service: Service, principal: Principal, job_id: uuid.UUID) -> Blob:
    """Return the newest preview of a running job, a PNG.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
        StorageError: the store does not have it.
    """
    job = await read_job(service, principal, job_id)
    if job.preview is None:
        raise not_found_error("picture yet")
    return await run_in_pool(ThreadPurpose.DOWNLOADS, service.storage.stat, job.preview["sha256"])


async def find_live_scene(service: Service, principal: Principal, job_id: uuid.UUID) -> ShownScene | None:
    """Return what is shown of a job's training; None if there is nothing.

    Raises:
        ProblemError: 404 if the job does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_job(connection, principal, job_id)
        return await get_shown_scene(connection, job_id)


async def get_live_scene(service: Service, principal: Principal, job_id: uuid.UUID) -> Blob | bytes:
    """Return the newest state of a job's training, a PLY file; with trained blocks in it, its content.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
        StorageError: the store does not have it.
    """
    shown = await find_live_scene(service, principal, job_id)
    if shown is None:
        raise not_found_error("state of its training")
    if shown.blocks:
        return await run_in_pool(
            ThreadPurpose.DOWNLOADS, build_live_scene, service.storage, shown, service.live_rows
        )
    return await run_in_pool(ThreadPurpose.DOWNLOADS, service.storage.stat, shown.scene.sha256)
