"""What becomes of an attempt, as it is written to the database: succeeded, failed, put back."""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, TypeVar

import psycopg

from octasplat.engine.errors import OctasplatError
from octasplat.workers.queue.attempts import MAX_RESCUES, Attempt, Result
from octasplat.workers.queue.storing import Note, storing
from octasplat.workers.records.quotas import QuotaExceeded
from octasplat.workers.store.errors import BlobMissing, DigestMismatch, StorageError, StorageUnavailable
from octasplat.workers.store.os_errors import lacks_room
from octasplat.workers.store.room import Taken
from octasplat.workers.work.contact import DATABASE_ERRORS, Contact
from octasplat.workers.work.reporter import Reporter
from octasplat.workers.work.surroundings import LostDatabase, Surroundings
from octasplat.workers.work.task import NO_SPACE
from octasplat.workers.work.workspace import Workspace

logger = logging.getLogger(__name__)
T = TypeVar("T")

CONTRADICTIONS = 3
"""So often a verdict is told again that contradicts what others changed at the same time."""


class Verdicts:
    """Writes what becomes of one attempt, again and again while the job is surely ours.

    Every method raises LostDatabase when that time is over, and Fenced when the job has gone on.

    Args:
        attempt: the claimed job.
        around: the worker.
        workspace: of the attempt.
        reporter: of the attempt.
        contact: says whether the job is ours.
        program: of the job; empty where this version does not know its kind.
    """

    def __init__(
        self,
        attempt: Attempt,
        around: Surroundings,
        workspace: Workspace,
        reporter: Reporter,
        contact: Contact,
        program: str,
    ) -> None:
        self._attempt = attempt
        self._around = around
        self._job = attempt.job
        self._workspace = workspace
        self._reporter = reporter
        self._contact = contact
        self._program = program

    async def publish(self) -> None:
        """Store the results and end the job with them."""
        try:
            results = await self._store_results()
        except StorageError as error:
            await self.give_up(error)
            return
        await self.succeed(results)

    async def succeed(self, results: list[Result]) -> None:
        """End the job with results that are published."""
        psnr = await asyncio.to_thread(self._workspace.measured_psnr, results)
        try:
            await self._said(lambda: self._attempt.succeed(results, psnr))
        except QuotaExceeded as error:
            described = {"type": "quota", "message": f"The results cannot be stored. {error}"}
            await self._said(lambda: self._attempt.fail(described, unwanted=results))
            await self._withdraw()
        self._around.host.worked()

    async def fail(self, error: dict[str, Any]) -> None:
        """End the job with what its program has finished."""
        try:
            await self._with_partial_results(lambda results, note: self._attempt.fail(error, results, note))
        except QuotaExceeded as excess:
            message = f"{error['message']} What it has finished cannot be stored. {excess}"
            await self._said(lambda: self._attempt.fail({**error, "message": message}))
        except StorageError as storage_error:
            await self.give_up(storage_error)

    async def refuse(self, error: psycopg.DataError) -> None:
        """End the job with the database's refusal of something that was to be written about it."""
        logger.error("what was to be written about job %s is refused: %s", self._job.id, error)
        described = {
            "type": "refused_value",
            "message": "The job says something that cannot be written down.",
        }
        await self._said(lambda: self._attempt.fail(described))

    async def cancel(self) -> None:
        """End the job as its owner asked."""
        await self._said(self._attempt.cancel)

    async def hand_back(self, reason: str) -> None:
        """Put the job back for no fault of its own."""
        await self._said(lambda: self._attempt.hand_back(self._around.slips, reason))

    async def lose(self, error: dict[str, Any]) -> None:
        """Put the job back after a failure that may be its own, or end it with what it has finished."""
        if self._job.rescues >= MAX_RESCUES:
            try:
                await self._with_partial_results(lambda results, note: self._let_go(error, results, note))
                return
            except (StorageError, QuotaExceeded) as storage_error:
                logger.warning("the results there are could not be stored: %s", storage_error)
        await self._said(lambda: self._let_go(error))

    async def let_go(self, error: dict[str, Any]) -> None:
        """Put the job back for a reason that may pass."""
        await self._said(lambda: self._let_go(error))

    async def give_up(self, error: OctasplatError) -> None:
        """Put the job back, or end it, after an error around its program."""
        described = _described(error)
        if isinstance(error, StorageUnavailable):
            await self.blame(described["message"])
        elif isinstance(error, StorageError) and not isinstance(error, BlobMissing | DigestMismatch):
            await self.let_go(described)
        else:
            await self._said(lambda: self._attempt.fail(described))

    async def blame(self, what: str) -> None:
        """Put the job back after a failure that may be this machine's: it counts only if it is not."""
        found = await self._around.host.examine(self._program)
        if found is None:
            error = {"type": "crashed", "message": what}
            await self.let_go(error)
        else:
            await self.hand_back(f"The worker's machine is at fault, which takes no jobs for now: {found}")

    async def _let_go(
        self, error: dict[str, Any], results: Sequence[Result] = (), note: Note | None = None
    ) -> None:
        """Put the job back, which counts.

        Where room is lacking, and would be without the job too, that is no fault of the job. One that fills a
        disk itself is tried again a few times, later and later, as others may have gone by then.
        """
        lacking = await self._around.lacking_room()
        if lacking is None and error["type"] != NO_SPACE:
            await self._attempt.lose(self._around.slips, error, results, note)
            return
        message = f"{error['message']} {lacking or ''}".strip()
        kept, taken = self._reporter.kept_bytes, await asyncio.to_thread(self._workspace.most_taken_bytes)
        if await self._around.lacking_room(Taken(taken, kept + taken)) is not None:
            await self._attempt.hand_back(self._around.slips, message)
            return
        # What it kept goes at the end if the store lacks room with it: nobody else could store anything.
        crowds = kept > 0 and await self._around.lacking_room(Taken(taken, taken)) is not None
        await self._attempt.lose(
            self._around.slips,
            {"type": NO_SPACE, "message": message},
            results,
            note,
            wait_seconds=self._around.settings.full_disk_seconds * 4**self._job.rescues,
            forget_checkpoint=crowds,
        )

    async def _store_results(self) -> list[Result]:
        """Store the results and publish their manifest."""
        while True:
            try:
                async with storing(self._attempt.pool, self._around.storage) as note:
                    manifest = await asyncio.to_thread(self._workspace.store_results)
                    contents = {file.sha256 for file in manifest.files}
                    await note.look(contents)
                    results = await asyncio.to_thread(self._workspace.publish, manifest)
                    try:
                        # The manifest names them for whoever collects; nobody did before it was there.
                        await note.look(contents)
                    except StorageUnavailable:
                        await asyncio.to_thread(self._workspace.withdraw)
                        raise
                    return results
            except DATABASE_ERRORS as error:
                await self._pause(error)

    async def _withdraw(self) -> None:
        """Nothing names results any more that are not wanted, so that they are collected."""
        try:
            await asyncio.to_thread(self._workspace.withdraw)
        except StorageError as error:
            logger.warning("the results of job %s stay in the store: %s", self._job.id, error)

    async def _with_partial_results(self, say: Callable[[list[Result], Note], Awaitable[None]]) -> None:
        """Store what a program has finished and say so."""
        while True:
            try:
                async with storing(self._attempt.pool, self._around.storage) as note:
                    results = await asyncio.to_thread(self._workspace.store_partial_results)
                    await say(results, note)
                    return
            except DATABASE_ERRORS as error:
                await self._pause(error)

    async def _said(self, say: Callable[[], Awaitable[T]]) -> T:
        """What ``say`` brings; it is given longer each time, or a slow database would never be told."""
        settings = self._around.settings
        seconds = settings.heartbeat_seconds
        contradicted = 0
        while True:
            try:
                async with asyncio.timeout(seconds):
                    return await say()
            except psycopg.IntegrityError as error:  # something was deleted at the same moment
                contradicted += 1
                if contradicted > CONTRADICTIONS:
                    raise
                await self._pause(error)
            except DATABASE_ERRORS as error:
                await self._pause(error)
                seconds = max(seconds, min(2 * seconds, settings.stale_seconds / 3))

    async def _pause(self, error: Exception) -> None:
        if self._contact.is_lost:
            raise LostDatabase(str(error)) from error
        await asyncio.sleep(self._around.settings.poll_seconds)


def _described(error: OctasplatError) -> dict[str, Any]:
    return {"type": NO_SPACE if lacks_room(error) else type(error).__name__, "message": str(error)}
