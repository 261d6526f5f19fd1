"""Results of jobs, and pictures of scenes in the making."""

import uuid

from octasplat.service.actions.access import owned_job, read_job, sought
from octasplat.service.auth import Principal
from octasplat.service.problems import not_found
from octasplat.service.state import Service
from octasplat.service.threads import Threads, in_thread
from octasplat.workers.queue import jobs as rows
from octasplat.workers.records.rows import Artifact
from octasplat.workers.store.protocol import Blob


async def list_artifacts(service: Service, who: Principal, job_id: uuid.UUID) -> list[Artifact]:
    """The results of a job.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        await owned_job(connection, who, job_id)
        return await rows.artifacts_of(connection, job_id)


async def get_artifact(
    service: Service, who: Principal, job_id: uuid.UUID, name: str, *, what: str = "result"
) -> Artifact:
    """A result of a job; without one the problem says that there is no such ``what``.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        await owned_job(connection, who, job_id)
        row = await rows.get_artifact(connection, job_id, sought(name, what))
    if row is None:
        raise not_found(what)
    return row


async def get_preview(service: Service, who: Principal, job_id: uuid.UUID) -> Blob:
    """The newest picture of the scene in the making, a PNG.

    Raises:
        Problem: 404.
        StorageError: the store does not have it.
    """
    job = await read_job(service, who, job_id)
    if job.preview is None:
        raise not_found("picture yet")
    return await in_thread(Threads.DOWNLOADS, service.storage.stat, job.preview["sha256"])
