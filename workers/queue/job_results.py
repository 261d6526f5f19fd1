"""Results of jobs, and how they become visible."""

from collections.abc import Sequence
from dataclasses import dataclass

from octasplat.workers.db.connections import Connection
from octasplat.workers.db.rows import Job


@dataclass(frozen=True)
class ResultFile:
    """A result to publish: its name, content and media type."""

    name: str
    sha256: str
    size_bytes: int
    media_type: str


def result_digests(results: Sequence[ResultFile]) -> set[str]:
    """Return the digests of the contents of results."""
    return {result.sha256 for result in results}


async def replace_artifacts(connection: Connection, job: Job, results: Sequence[ResultFile]) -> None:
    """Replace the results of a job; the one place where they become visible."""
    await connection.execute("DELETE FROM artifacts WHERE job_id = %s", [job.id])
    await connection.execute(
        """
        INSERT INTO artifacts (job_id, name, sha256, size_bytes, media_type)
        SELECT %s, given.* FROM unnest(%s::text[], %s::text[], %s::bigint[], %s::text[]) AS given
        """,
        [
            job.id,
            [result.name for result in results],
            [result.sha256 for result in results],
            [result.size_bytes for result in results],
            [result.media_type for result in results],
        ],
    )
