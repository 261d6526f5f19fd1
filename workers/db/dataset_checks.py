"""Validations of datasets in progress: announced, begun, renewed, and ended or abandoned."""

import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from octasplat.workers.db.connections import Connection
from octasplat.workers.db.datasets import STALE_CHECK_SECONDS, get_dataset, is_check_stale
from octasplat.workers.db.errors import ConflictError, NotFoundError
from octasplat.workers.db.postgres_text import as_json
from octasplat.workers.db.rows import Dataset


@dataclass(frozen=True)
class Check:
    """A validation in progress.

    Attributes:
        dataset: as it was when it began; one that is committed needs none.
        said_at: when it was said to go on. The row holds one of these times for as long as the dataset is
            this validation's: one that was silent for long, as its process was frozen, is over.
    """

    dataset: Dataset
    said_at: list[datetime] = field(default_factory=list)


async def announce_check(connection: Connection, dataset: Dataset) -> None:
    """Close a dataset, which this transaction has locked, for a validation that is about to begin.

    Raises:
        ConflictError: it is being validated already.
    """
    if dataset.state == "checking" and not await is_check_stale(connection, dataset.id):
        raise ConflictError("The dataset is being checked already; ask again in a moment.")
    await _close(connection, dataset.id)


async def begin_check(connection: Connection, dataset_id: uuid.UUID) -> Check:
    """Close a dataset for its validation by this process, whoever has closed it before.

    Raises:
        NotFoundError: there is no such dataset.
    """
    async with connection.transaction():
        dataset = await get_dataset(connection, dataset_id, lock=True)
        if dataset is None:
            raise NotFoundError("dataset")
        check = Check(dataset)
        if dataset.state != "committed":
            check.said_at.append(await _close(connection, dataset_id))
        return check


async def _close(connection: Connection, dataset_id: uuid.UUID) -> datetime:
    """Close a dataset for its validation; returns when."""
    said_at = await _database_time(connection)
    await connection.execute(
        "UPDATE datasets SET state = 'checking', used_at = %s, expires_at = NULL WHERE id = %s",
        [said_at, dataset_id],
    )
    return said_at


async def renew_check(connection: Connection, check: Check) -> None:
    """Renew the validation of a dataset, so that it does not count as abandoned."""
    before = list(check.said_at)
    check.said_at.append(
        await _database_time(connection)
    )  # known before it is written, as the answer may be lost
    await connection.execute(
        "UPDATE datasets SET used_at = %s WHERE id = %s AND state = 'checking' AND used_at = ANY(%s)",
        [check.said_at[-1], check.dataset.id, before],
    )


async def reopen_stale_checks(connection: Connection) -> int:
    """Reopen datasets whose validation was abandoned and no task goes on with; returns how many."""
    cursor = await connection.execute(
        """
        UPDATE datasets SET state = 'open' WHERE id IN (
            SELECT id FROM datasets WHERE state = 'checking' AND used_at < now() - make_interval(secs => %s)
              AND NOT EXISTS (
                SELECT FROM dataset_tasks WHERE dataset_id = datasets.id AND kind = 'commit'
                  AND state IN ('queued', 'running')
              )
            ORDER BY id FOR UPDATE SKIP LOCKED
        )
        """,
        [2 * STALE_CHECK_SECONDS],
    )
    return cursor.rowcount


async def end_check(
    connection: Connection,
    check: Check,
    *,
    is_valid: bool,
    has_poses: bool = False,
    photographs: int = 0,
    facts: Mapping[str, Any] | None = None,
) -> Dataset:
    """Commit a valid dataset, or reopen an invalid one for corrections.

    Nothing changes where the dataset is not this validation's any more; the row says so.

    Raises:
        NotFoundError: there is no such dataset any more.
    """
    await connection.execute(
        """
        UPDATE datasets SET state = CASE WHEN %(sound)s THEN 'committed' ELSE 'open' END,
            committed_at = CASE WHEN %(sound)s THEN now() END, has_poses = %(poses)s,
            photographs = %(photographs)s, facts = %(facts)s
        WHERE id = %(id)s AND state = 'checking' AND used_at = ANY(%(said_at)s)
        """,
        {
            "said_at": check.said_at,
            "sound": is_valid,
            "poses": has_poses,
            "photographs": photographs,
            "facts": as_json(dict(facts or {})),
            "id": check.dataset.id,
        },
    )
    dataset = await get_dataset(connection, check.dataset.id)
    if dataset is None:
        raise NotFoundError("dataset")
    return dataset


async def _database_time(connection: Connection) -> datetime:
    """Return the time by the database's clock."""
    row = await (await connection.execute("SELECT clock_timestamp() AS at")).fetchone()
    assert row is not None
    at: datetime = row["at"]
    return at
