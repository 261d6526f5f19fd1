"""Quotas of owners: bytes, datasets, and unfinished jobs; all tokens of an owner share them.

The checks take a lock of the owner until the end of the transaction, so that a check and the insertion that
follows in the same transaction are atomic, however many requests arrive at once. A transaction that also
locks a job or a dataset takes that lock first, see :mod:`octasplat.workers.db.locks`. The database counts
bytes as they change (``migrations/0012_locks.sql``), so the time of a check does not depend on how much is
stored.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal, LiteralString

from psycopg.rows import class_row

from octasplat.engine.core.errors import OctasplatError
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.locks import lock_owner


class QuotaExceededError(OctasplatError):
    """An owner has as much as allowed; ``resource`` says of what."""

    error_type = "quota_exceeded"

    def __init__(self, resource: Literal["bytes", "datasets", "jobs"], message: str) -> None:
        super().__init__(message)
        self.resource = resource


@dataclass(frozen=True)
class Quota:
    """Limits; None sets none.

    Attributes:
        max_bytes: files of datasets, results, and checkpoints of jobs that have not succeeded; content that
            occurs twice counts once.
        max_datasets: datasets.
        max_jobs: jobs that are queued or running; one in blocks is one.
        share: of the workers, where that of others is 1; see :mod:`octasplat.workers.queue.fair_share`.
    """

    max_bytes: int | None = None
    max_datasets: int | None = None
    max_jobs: int | None = None
    share: float | None = None

    def with_defaults(self, default: "Quota") -> "Quota":
        """Return these limits, and where there is none that of ``default``."""
        return Quota(
            default.max_bytes if self.max_bytes is None else self.max_bytes,
            default.max_datasets if self.max_datasets is None else self.max_datasets,
            default.max_jobs if self.max_jobs is None else self.max_jobs,
            default.share if self.share is None else self.share,
        )


@dataclass(frozen=True)
class Usage:
    """Usage of an owner, counted as in :class:`Quota`."""

    bytes: int
    datasets: int
    jobs: int


NO_QUOTA = Quota()


async def quota_of(connection: Connection, owner: str, default: Quota = NO_QUOTA) -> Quota:
    """Return the limits of an owner."""
    async with connection.cursor(row_factory=class_row(Quota)) as cursor:
        await cursor.execute(
            "SELECT max_bytes, max_datasets, max_jobs, share FROM quotas WHERE owner = %s", [owner]
        )
        return (await cursor.fetchone() or NO_QUOTA).with_defaults(default)


async def set_quota(connection: Connection, owner: str, quota: Quota) -> None:
    """Set all limits of an owner, and its share."""
    await connection.execute(
        """
        INSERT INTO quotas (owner, max_bytes, max_datasets, max_jobs, share) VALUES (%s, %s, %s, %s, %s)
        ON CONFLICT (owner) DO UPDATE SET max_bytes = excluded.max_bytes,
            max_datasets = excluded.max_datasets, max_jobs = excluded.max_jobs, share = excluded.share
        """,
        [owner, quota.max_bytes, quota.max_datasets, quota.max_jobs, quota.share],
    )


async def usage_of(connection: Connection, owner: str) -> Usage:
    """Return what an owner has."""
    async with connection.cursor(row_factory=class_row(Usage)) as cursor:
        await cursor.execute(
            """
            SELECT
                (SELECT coalesce(sum(bytes), 0)::bigint FROM owner_usage WHERE owner = %(owner)s) AS bytes,
                (SELECT count(*) FROM datasets WHERE owner = %(owner)s) AS datasets,
                (SELECT count(*) FROM jobs WHERE owner = %(owner)s
                 AND root_id IS NULL AND state IN ('queued', 'running', 'canceling')) AS jobs
            """,
            {"owner": owner},
        )
        usage = await cursor.fetchone()
    assert usage is not None
    return usage


async def bytes_left(connection: Connection, owner: str, default: Quota = NO_QUOTA) -> int | None:
    """Return how many bytes more an owner may store, at least 0; None without a limit. Takes no lock."""
    quota = await quota_of(connection, owner, default)
    if quota.max_bytes is None:
        return None
    return max(0, quota.max_bytes - await _stored_bytes(connection, owner))


@dataclass(frozen=True)
class Recounted:
    """An owner whose bytes were counted wrong."""

    owner: str
    bytes_before: int
    bytes: int


async def recount(connection: Connection) -> list[Recounted]:
    """Recount the bytes of all owners, with changes locked out; returns those that were wrong, by owner."""
    async with connection.transaction(), connection.cursor(row_factory=class_row(Recounted)) as cursor:
        await cursor.execute(
            "SELECT whose AS owner, bytes_before, bytes_after AS bytes FROM octasplat_recount()"
        )
        return await cursor.fetchall()


async def owned_bytes(connection: Connection, owner: str, sha256: str) -> int:
    """Return what of an owner's bytes is content of that digest; 0 if they do not have it."""
    query = """
        SELECT coalesce(sum(size_bytes), 0)::bigint AS n FROM owner_contents WHERE owner = %s AND sha256 = %s
        """
    return await _query_number(connection, query, [owner, sha256])


async def owned_contents(connection: Connection, owner: str, contents: Collection[str]) -> dict[str, int]:
    """Return the lengths of those contents, by digest, that an owner has."""
    cursor = await connection.execute(
        "SELECT sha256, size_bytes FROM owner_contents WHERE owner = %s AND sha256 = ANY(%s)",
        [owner, list(contents)],
    )
    return {row["sha256"]: row["size_bytes"] for row in await cursor.fetchall()}


async def check_bytes(connection: Connection, owner: str, default: Quota = NO_QUOTA) -> None:
    """Check the owner's bytes after an insertion in this transaction.

    Raises:
        QuotaExceededError: the owner has more bytes than allowed; the transaction must be rolled back.
    """
    quota = await _locked_quota(connection, owner, default)
    if quota.max_bytes is None:
        return
    used = await _stored_bytes(connection, owner)
    if used > quota.max_bytes:
        raise QuotaExceededError(
            "bytes",
            f"This would take {used} bytes of your {quota.max_bytes}; delete datasets or jobs first.",
        )


async def check_new_dataset(connection: Connection, owner: str, default: Quota = NO_QUOTA) -> None:
    """Check the owner's quota before a dataset is created in this transaction.

    Raises:
        QuotaExceededError: the owner has as many as allowed.
    """
    quota = await _locked_quota(connection, owner, default)
    if quota.max_datasets is None:
        return
    # Counts no further than the limit, however many rows there are.
    query = "SELECT count(*) AS n FROM (SELECT 1 FROM datasets WHERE owner = %s LIMIT %s) AS found"
    if await _query_number(connection, query, [owner, quota.max_datasets]) >= quota.max_datasets:
        raise QuotaExceededError(
            "datasets", f"You have all of your {quota.max_datasets} datasets; delete one first."
        )


async def check_new_job(connection: Connection, owner: str, default: Quota = NO_QUOTA) -> None:
    """Check the owner's quota before a job is created, or queued again, in this transaction.

    Raises:
        QuotaExceededError: as many as allowed are not over yet.
    """
    quota = await _locked_quota(connection, owner, default)
    if quota.max_jobs is None:
        return
    query = """
        SELECT count(*) AS n FROM (
            SELECT 1 FROM jobs
            WHERE owner = %s AND root_id IS NULL AND state IN ('queued', 'running', 'canceling') LIMIT %s
        ) AS found
        """
    if await _query_number(connection, query, [owner, quota.max_jobs]) >= quota.max_jobs:
        raise QuotaExceededError(
            "jobs",
            f"{quota.max_jobs} of your jobs are queued or running, which is as many as allowed; "
            "wait for one or cancel one.",
        )


async def _locked_quota(connection: Connection, owner: str, default: Quota) -> Quota:
    quota = await quota_of(connection, owner, default)
    # Without any limit there is nothing to compare, and nobody has to wait.
    if quota != NO_QUOTA:
        await lock_owner(connection, owner)
    return quota


async def _stored_bytes(connection: Connection, owner: str) -> int:
    query = "SELECT coalesce(sum(bytes), 0)::bigint AS n FROM owner_usage WHERE owner = %s"
    return await _query_number(connection, query, [owner])


async def _query_number(connection: Connection, query: LiteralString, values: Sequence[object]) -> int:
    row = await (await connection.execute(query, values)).fetchone()
    assert row is not None
    return int(row["n"])
