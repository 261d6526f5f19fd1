"""Reasons for which a job's program is stopped early, and the one that its use of the disk gives."""

import asyncio
import logging
import uuid
from concurrent.futures import Executor
from enum import Enum

from octasplat.workers.storage.errors import StorageError, StorageFullError, UntrustedFileError
from octasplat.workers.worker.context import WorkerContext
from octasplat.workers.worker.workspace import Workspace

logger = logging.getLogger(__name__)


class StopReason(Enum):
    """Reason for which a child process was stopped early."""

    FENCED = "the job has gone on without this worker"
    DATABASE_LOST = "the database was lost"
    CANCELED = "its owner cancelled it"
    DRAINING = "its worker is stopping"
    SILENT = "its program said nothing for too long"
    TIME_LIMIT = "it ran for longer than allowed"
    MEMORY_LIMIT = "its program needed more memory than allowed"
    PROCESS_LIMIT = "it started more processes than allowed"
    DISK_LIMIT = "its folder took more than allowed"
    DISK_RESERVE = "it took room that is reserved"
    HIDDEN_FILES = "its folder could not be measured"
    UNWATCHED = "its limits could not be watched any more"

    @property
    def gives_time(self) -> bool:
        """Return whether the process may stop by itself, and so may have ended its work before."""
        return self in (StopReason.CANCELED, StopReason.DRAINING, StopReason.TIME_LIMIT)


async def disk_stop_reason(
    context: WorkerContext, workspace: Workspace, job_id: uuid.UUID, executor: Executor
) -> StopReason | None:
    """Return why a program that fills the disk is to be stopped, of several the one that used most.

    Args:
        context: of the worker; what the job takes is noted there.
        workspace: of the job.
        job_id: of the job.
        executor: for what may wait for the disk.
    """
    loop = asyncio.get_running_loop()
    try:
        taken = await loop.run_in_executor(executor, workspace.used_bytes)
    except UntrustedFileError as error:
        logger.info("job %s hides what it stores: %s", job_id, error)
        return StopReason.HIDDEN_FILES
    context.taken_bytes[job_id] = taken
    if 0 < context.settings.max_workspace_bytes < taken:
        return StopReason.DISK_LIMIT
    try:
        await loop.run_in_executor(executor, context.disk_space.ensure_workspace, 0)
    except StorageFullError:
        if taken >= max(context.taken_bytes.values()):
            return StopReason.DISK_RESERVE
    except StorageError as error:
        logger.info("the disk of job %s was not looked at: %s", job_id, error)
    return None
