"""Health of the host: a job that fails for a fault of the machine is not blamed for it."""

import asyncio
import json
import logging
import os
import tempfile
import time
import uuid
from collections.abc import Sequence
from pathlib import Path

from octasplat.workers.storage.errors import StorageError, StorageFullError
from octasplat.workers.storage.os_errors import translate_os_errors
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.worker.child_process import child_command, child_environment

logger = logging.getLogger(__name__)

PROBE_SECONDS = 120.0
MAX_CRASHES, MIN_CRASH_OWNERS = 3, 2
"""So many jobs in a row, of so many owners, whose programs crash are taken for a fault of the machine; one
owner alone cannot bring that about."""


class HostHealth:
    """Monitors faults of this machine.

    Args:
        name: of the worker, for the log.
        work: folder of the work under way.
        storage: the store.
        kind_modules: further modules that a job's process imports.
        cooldown_seconds: for how long it takes no jobs after many have crashed.
    """

    def __init__(
        self,
        name: str,
        work: Path,
        storage: Storage,
        *,
        kind_modules: Sequence[str] = (),
        cooldown_seconds: float = 30.0,
    ) -> None:
        self._name = name
        self._work = work
        self._storage = storage
        self._kind_modules = tuple(kind_modules)
        self._crashed_jobs: dict[uuid.UUID, str] = {}
        self._cooldown_seconds = cooldown_seconds
        self._cooldown_until = 0.0
        self._program: str | None = None
        self.fault: str | None = None
        self.changed = asyncio.Event()

    def record_crash(self, job_id: uuid.UUID, owner: str) -> None:
        """Record that the program of a job crashed."""
        # By job, so that one that crashes several times counts once.
        self._crashed_jobs[job_id] = owner
        if (
            len(self._crashed_jobs) >= MAX_CRASHES
            and len(set(self._crashed_jobs.values())) >= MIN_CRASH_OWNERS
        ):
            self._cooldown_until = time.monotonic() + self._cooldown_seconds
            self.mark_faulty(
                f"the programs of {len(self._crashed_jobs)} jobs, of several owners, crashed in a row"
            )

    def record_success(self) -> None:
        """Record that a job finished here."""
        self._crashed_jobs.clear()

    def mark_faulty(self, fault: str) -> None:
        """Take no jobs until :meth:`try_recover` finds no fault any more."""
        if self.fault is None:
            logger.error("worker %s takes no jobs: %s", self._name, fault)
        self.fault = fault
        self.changed.set()

    async def check_work_folder(self) -> str | None:
        """Check the work folder before a job; return what is wrong in a sentence, or None."""
        try:
            await asyncio.to_thread(self._write_probe_file)
        except StorageFullError:
            return None  # which is looked after where room is
        except StorageError as error:
            return str(error)
        return None

    async def diagnose(self, program: str) -> str | None:
        """Check the machine after a failure; return what is wrong in a sentence, or None.

        Args:
            program: of the job that failed.
        """
        found = await self.check_work_folder() or await self._check_store()
        if found is None and program:
            found = await self._probe_program(program)
        if found is not None:
            self._program = program or None
            self.mark_faulty(found)
        return found

    async def try_recover(self) -> bool:
        """Return whether jobs can be taken again; a remaining fault is in :attr:`fault`."""
        # After crashes there is nothing to probe, so that time alone decides.
        if time.monotonic() < self._cooldown_until:
            return False
        found = await self.check_work_folder() or await self._check_store()
        if found is None and self._program is not None:
            found = await self._probe_program(self._program)
        if found is not None:
            self.mark_faulty(found)
            return False
        logger.info("worker %s is well again", self._name)
        self._crashed_jobs.clear()
        self.fault = self._program = None
        return True

    def _write_probe_file(self) -> None:
        with translate_os_errors(self._work):
            folder = self._work / "attempts"
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder) as handle:
                # A file can be opened on a full or failing disk; only written bytes tell.
                handle.write(b"x")
                handle.flush()

    async def _check_store(self) -> str | None:
        try:
            await asyncio.to_thread(self._storage.check)
        except StorageError as error:
            return str(error)
        return None

    async def _probe_program(self, program: str) -> str | None:
        """Return whether a process starts and can import the program of a job."""
        try:
            process = await asyncio.create_subprocess_exec(
                *child_command(self._kind_modules),
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.PIPE,
                start_new_session=True,
                env=child_environment(os.environ),
                cwd="/",
            )
        except OSError as error:
            return f"No process can be started ({error.strerror or error})."
        task = {
            "program": program,
            "kind_modules": self._kind_modules,
            "probe": True,
        }
        try:
            async with asyncio.timeout(PROBE_SECONDS):
                assert process.stdin is not None and process.stderr is not None
                process.stdin.write(json.dumps(task).encode() + b"\n")
                output = await process.stderr.read()  # it takes the end of its stdin for that of its worker
                await process.wait()
                process.stdin.close()
        except TimeoutError:
            process.kill()
            return f"A job's program was not ready after {PROBE_SECONDS:g} s."
        if process.returncode == 0:
            return None
        last = output.decode(errors="replace").strip().rpartition("\n")[2][-300:]
        return f"A job's program cannot be started here (exit code {process.returncode}): {last}"
