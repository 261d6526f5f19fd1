"""Periodic tasks of a worker for the whole service: lost jobs, expiry, webhooks, and remains to remove."""

import asyncio
import logging
import tempfile
from pathlib import Path

from octasplat.workers.db.connections import Pool
from octasplat.workers.db.workers import remove_stale_workers
from octasplat.workers.maintenance.garbage_collection import collect_garbage
from octasplat.workers.maintenance.retention import apply_retention, thin_progress_events
from octasplat.workers.maintenance.webhooks.sender import WebhookSender
from octasplat.workers.queue.job_deadlines import fail_abandoned_jobs
from octasplat.workers.queue.recovery import StalledAttempts, recover_stalled_jobs
from octasplat.workers.settings import WorkerSettings
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.worker.context import WorkerContext
from octasplat.workers.worker.periodic_tasks import PeriodicTask
from octasplat.workers.worker.workspace_locks import sweep_temporary, sweep_workspaces

logger = logging.getLogger(__name__)

RECOVERY_TIMEOUT_SECONDS = 60.0
"""Looking for lost jobs is begun again after this time, so that nothing that hangs keeps them waiting."""
SWEEP_SECONDS = 60.0
STORE_SWEEP_SECONDS = 3600.0
THIN_EVENTS_SECONDS = 600.0
STALE_UPLOAD_SECONDS = 86_400.0
WORKERS_BACK_SECONDS = 600.0
"""A queue is taken for abandoned when it has been seen without a worker for so long, however old its jobs."""


class Housekeeping:
    """What each worker does now and then for the service, whatever its jobs do.

    Args:
        settings: of the worker.
        pool: connections.
        context: of the worker.
    """

    def __init__(self, settings: WorkerSettings, pool: Pool, context: WorkerContext) -> None:
        self._settings = settings
        self._pool = pool
        self._context = context
        # A worker that lives is heard of in between, also where all of this machine stood still.
        self._stalled = StalledAttempts(1.5 * settings.heartbeat_seconds + settings.poll_seconds)
        self._abandoned = StalledAttempts(WORKERS_BACK_SECONDS)
        self._sender = WebhookSender(pool, settings.webhook_hosts)

    def tasks(self) -> tuple[PeriodicTask, ...]:
        """Return the tasks, to be run periodically."""
        settings = self._settings
        return (
            PeriodicTask(self._recover_stalled, settings.rescue_seconds, RECOVERY_TIMEOUT_SECONDS),
            PeriodicTask(self._sweep_workspaces, SWEEP_SECONDS),
            PeriodicTask(self._sweep_store, STORE_SWEEP_SECONDS),
            PeriodicTask(self._send_webhooks, settings.poll_seconds),
            PeriodicTask(self._delete_expired, SWEEP_SECONDS),
            PeriodicTask(self._thin_events, THIN_EVENTS_SECONDS),
            PeriodicTask(self._collect_garbage, settings.collect_seconds),
        )

    async def close(self) -> None:
        """Give up the deliveries under way."""
        await self._sender.close()

    async def _recover_stalled(self) -> None:
        await recover_stalled_jobs(
            self._pool, self._context.job_queue, self._settings.stale_seconds, self._stalled
        )
        async with self._pool.connection() as connection:
            await remove_stale_workers(connection, max(60.0, 3 * self._settings.stale_seconds))

    async def _send_webhooks(self) -> None:
        await self._sender.start_due()

    async def _delete_expired(self) -> None:
        """Apply the retention times."""
        await apply_retention(self._pool, self._settings.retention, self._settings.keep_audit_hours)
        for job_id in await fail_abandoned_jobs(
            self._pool,
            self._context.job_queue,
            stale_seconds=self._settings.stale_seconds,
            hours=self._settings.absent_queue_hours,
            suspects=self._abandoned,
        ):
            logger.warning("job %s waited too long in a queue that no worker takes", job_id)

    async def _thin_events(self) -> None:
        async with self._pool.connection() as connection:
            await thin_progress_events(connection)

    async def _collect_garbage(self) -> None:
        try:
            await collect_garbage(
                self._pool,
                self._context.storage,
                unused_seconds=3600 * self._settings.keep_unused_hours,
                every_seconds=0.9 * self._settings.collect_seconds,
            )
        except StorageError as error:
            logger.info("unused contents were not collected: %s", error)

    async def _sweep_workspaces(self) -> None:
        await asyncio.to_thread(sweep_workspaces, self._settings.work_folder)
        await asyncio.to_thread(sweep_temporary, Path(tempfile.gettempdir()), STALE_UPLOAD_SECONDS)

    async def _sweep_store(self) -> None:
        """Remove the remains of killed uploads from the storage; no upload takes a day."""
        try:
            await asyncio.to_thread(self._context.storage.remove_stale_uploads, STALE_UPLOAD_SECONDS)
        except StorageError as error:
            logger.info("the store was not swept: %s", error)
