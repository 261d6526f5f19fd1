"""Live workers of a queue: which can run a job, and the notes for its owner."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from pydantic import BaseModel

from octasplat.engine.files import exporter_for, exporters
from octasplat.service.problems import ProblemError
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.rows import WorkerRow
from octasplat.workers.db.workers import live_workers
from octasplat.workers.worker.job_kinds import JobKind
from octasplat.workers.worker.path_redaction import shorten_absolute_paths


async def live_workers_of_queue(connection: Connection, queue: str, stale_seconds: float) -> list[WorkerRow]:
    """Return the live workers that take jobs from a queue."""
    return [row for row in await live_workers(connection, stale_seconds) if queue in row.queues]


def unwritable_formats(workers: Sequence[WorkerRow]) -> dict[str, str]:
    """Return formats that none of ``workers`` can write, with their missing requirements.

    Without workers there are none: nobody can say what those that come will be able to write.
    """
    takers = [row for row in workers if row.queues]  # others look after lost jobs only
    if not takers:
        return {}
    able = {str(name) for row in takers for name in row.facts.get("formats", _ALL_FORMATS)}
    return {exporter.name: exporter.description for exporter in exporters() if exporter.name not in able}


def check_formats_writable(
    kind: JobKind, options: BaseModel, queue: str, workers: Sequence[WorkerRow]
) -> None:
    """Refuse files that no live worker of the queue can write.

    Raises:
        ProblemError: 422, with the place of each such file.
    """
    lacking = unwritable_formats(workers)
    faults = [
        {
            "pointer": f"#/options/{kind.export_option}/{place}",
            "detail": f"No worker of the queue {queue} can write {name}: {lacking[form]}.",
        }
        for place, name in enumerate(kind.exported_files(options))
        if (form := exporter_for(Path(name)).name) in lacking
    ]
    if faults:
        detail = f"{faults[0]['detail']} Ask for other files, or have it installed where the workers run."
        raise ProblemError(422, "unwritable", detail, errors=faults)


def queued_job_notes(
    kind: JobKind, options: BaseModel, queue: str, workers: Sequence[WorkerRow]
) -> list[str]:
    """Return sentences for the owner of a queued job."""
    if workers:
        # A worker that does not tell its kinds is taken to know this one.
        takers = [row for row in workers if kind.name in row.facts.get("kinds", (kind.name,))]
        if takers:
            return _refusing_workers_note(queue, takers)
        return [
            f"No worker of the queue {queue} knows jobs of the kind {kind.name}; the job waits for one of a "
            "newer version."
        ]
    notes = [f"No worker takes jobs from the queue {queue} now; the job waits for one."]
    needy = [name for name in kind.exported_files(options) if "needs" in exporter_for(Path(name)).description]
    if needy:
        notes.append(f"Whether {' and '.join(needy)} can be written is not known before a worker is there.")
    return notes


def paused_queue_note(queue: str) -> str:
    """Return that an administrator has paused a queue."""
    return f"An administrator has paused the queue {queue}; the job waits until it goes on."


def drained_workers_note(workers: Sequence[WorkerRow], drained: Collection[str], queue: str) -> list[str]:
    """Return that all workers of a queue are drained, if they are."""
    if not workers or any(row.name not in drained for row in workers):
        return []
    return [f"All workers of the queue {queue} are being drained; the job waits for another one."]


def busy_workers_note(workers: Sequence[WorkerRow], running: Mapping[str, int], queue: str) -> list[str]:
    """Return that all workers of a queue are busy, if they are.

    Args:
        workers: of the queue.
        running: number of running jobs by queue.
        queue: its name.
    """
    places = sum(row.slots for row in workers)
    if not places or running.get(queue, 0) < places:
        return []
    return [f"The workers of the queue {queue} do as many jobs as they can at once ({places})."]


def _refusing_workers_note(queue: str, takers: Sequence[WorkerRow]) -> list[str]:
    """Return why none of the workers takes a job; nothing where one of them does."""
    reasons = [row.facts.get("ailing") for row in takers]
    distinct = dict.fromkeys(shorten_absolute_paths(str(reason)).rstrip(".") for reason in reasons if reason)
    if not all(reasons):
        return []
    return [f"The workers of the queue {queue} take no jobs for now: {'; '.join(distinct)}."]


_ALL_FORMATS = tuple(exporter.name for exporter in exporters())
"""What a worker of an earlier version, which does not say, is taken to write."""
