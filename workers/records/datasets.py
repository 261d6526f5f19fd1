"""Datasets and their files in the tables."""

import uuid
from collections.abc import Mapping, Sequence
from typing import Any

from psycopg.rows import class_row, dict_row
from psycopg.types.json import Jsonb

from octasplat.engine.photograph_sizes import Sizes
from octasplat.workers.records.database import Connection, naming
from octasplat.workers.records.errors import Conflict, Missing
from octasplat.workers.records.ids import new_id
from octasplat.workers.records.rows import Dataset, DatasetFile, DatasetHolds

CHECK_LOST_SECONDS = 60
"""A validation of which nothing was heard for so long counts no more; its process is gone."""


async def create_dataset(
    connection: Connection, owner: str, name: str, holds: DatasetHolds = "photographs"
) -> Dataset:
    """A new dataset that takes files."""
    dataset_id = new_id()
    await connection.execute(
        "INSERT INTO datasets (id, owner, name, holds) VALUES (%s, %s, %s, %s)",
        [dataset_id, owner, name, holds],
    )
    dataset = await get_dataset(connection, dataset_id)
    assert dataset is not None
    return dataset


async def get_dataset(connection: Connection, dataset_id: uuid.UUID, *, lock: bool = False) -> Dataset | None:
    """The dataset of that id, or None."""
    query = "SELECT {} FROM datasets WHERE id = %s"
    async with connection.cursor(row_factory=class_row(Dataset)) as cursor:
        await cursor.execute(naming(f"{query} FOR UPDATE" if lock else query, Dataset), [dataset_id])
        return await cursor.fetchone()


async def list_datasets(
    connection: Connection, *, owner: str | None = None, before: uuid.UUID | None = None, limit: int = 50
) -> list[Dataset]:
    """Datasets, the newest first; ``owner`` None takes everybody's."""
    async with connection.cursor(row_factory=class_row(Dataset)) as cursor:
        await cursor.execute(
            naming(
                """
            SELECT {} FROM datasets
            WHERE (%(owner)s::text IS NULL OR owner = %(owner)s)
              AND (%(before)s::uuid IS NULL OR id < %(before)s)
            ORDER BY id DESC LIMIT %(limit)s
            """,
                Dataset,
            ),
            {"owner": owner, "before": before, "limit": limit},
        )
        return await cursor.fetchall()


async def files_named(
    connection: Connection, owner: str, endings: Sequence[str], *, limit: int
) -> list[tuple[Dataset, str]]:
    """Files that options may name, whose names end so, with their committed datasets; the newest first."""
    async with connection.cursor(row_factory=dict_row) as cursor:
        await cursor.execute(
            """
            SELECT f.path AS file_path, d.* FROM datasets d JOIN dataset_files f ON f.dataset_id = d.id
            WHERE d.owner = %s AND d.holds = 'files' AND d.state = 'committed'
              AND lower(f.path) LIKE ANY(%s)
            ORDER BY d.id DESC, f.path LIMIT %s
            """,
            [owner, [f"%{ending}" for ending in endings], limit],
        )
        return [(Dataset(**row), path) for row in await cursor.fetchall() if (path := row.pop("file_path"))]


async def put_file(
    connection: Connection,
    dataset_id: uuid.UUID,
    path: str,
    sha256: str,
    size_bytes: int,
    facts: Mapping[str, Any] | None = None,
) -> DatasetFile:
    """Record a file that has arrived, in the place of one of the same path.

    Raises:
        Conflict: the dataset takes no files any more.
        Missing: there is no such dataset.
    """
    async with connection.transaction():
        await _open_dataset(connection, dataset_id)
        await connection.execute(
            """
            INSERT INTO dataset_files (dataset_id, path, sha256, size_bytes, facts)
            VALUES (%s, %s, %s, %s, %s)
            ON CONFLICT (dataset_id, path) DO UPDATE
            SET sha256 = excluded.sha256, size_bytes = excluded.size_bytes, facts = excluded.facts,
                uploaded_at = now()
            """,
            [dataset_id, path, sha256, size_bytes, Jsonb(dict(facts or {}))],
        )
        file = await get_file(connection, dataset_id, path)
    assert file is not None
    return file


async def remove_file(connection: Connection, dataset_id: uuid.UUID, path: str) -> bool:
    """Take a file out of an open dataset; False if there was none.

    Raises:
        Conflict: the dataset does not change any more.
        Missing: there is no such dataset.
    """
    async with connection.transaction():
        await _open_dataset(connection, dataset_id)
        cursor = await connection.execute(
            "DELETE FROM dataset_files WHERE dataset_id = %s AND path = %s", [dataset_id, path]
        )
        return cursor.rowcount > 0


async def get_file(connection: Connection, dataset_id: uuid.UUID, path: str) -> DatasetFile | None:
    """One file of a dataset, or None."""
    async with connection.cursor(row_factory=class_row(DatasetFile)) as cursor:
        await cursor.execute(
            naming("SELECT {} FROM dataset_files WHERE dataset_id = %s AND path = %s", DatasetFile),
            [dataset_id, path],
        )
        return await cursor.fetchone()


async def files_of(
    connection: Connection, dataset_id: uuid.UUID, *, after: str = "", limit: int | None = None
) -> list[DatasetFile]:
    """Files of a dataset by path; those after the path ``after``, at most ``limit``."""
    async with connection.cursor(row_factory=class_row(DatasetFile)) as cursor:
        await cursor.execute(
            naming(
                """
            SELECT {} FROM dataset_files WHERE dataset_id = %s AND path COLLATE "C" > %s
            ORDER BY path COLLATE "C" LIMIT %s
            """,
                DatasetFile,
            ),
            [dataset_id, after, limit],
        )
        return await cursor.fetchall()


async def photograph_sizes(connection: Connection, dataset_id: uuid.UUID) -> list[Sizes]:
    """How many photographs of which size a dataset has, of those whose size is known."""
    cursor = await connection.execute(
        """
        SELECT (facts->>'width_px')::int AS width, (facts->>'height_px')::int AS height, count(*) AS n
        FROM dataset_files
        WHERE dataset_id = %s AND path LIKE 'images/%%' AND facts->>'width_px' IS NOT NULL
            AND facts->>'height_px' IS NOT NULL
        GROUP BY 1, 2 ORDER BY 3 DESC, 1, 2
        """,
        [dataset_id],
    )
    return [Sizes(row["width"], row["height"], row["n"]) for row in await cursor.fetchall()]


async def begin_check(connection: Connection, dataset_id: uuid.UUID) -> Dataset:
    """Close an open dataset for the time of its validation.

    Raises:
        Conflict: it is being validated already.
        Missing: there is no such dataset.
    """
    async with connection.transaction():
        dataset = await get_dataset(connection, dataset_id, lock=True)
        if dataset is None:
            raise Missing("dataset")
        if dataset.state == "checking" and not await _check_was_lost(connection, dataset_id):
            raise Conflict("The dataset is being checked already; ask again in a moment.")
        if dataset.state != "committed":
            await connection.execute(
                "UPDATE datasets SET state = 'checking', used_at = now(), expires_at = NULL WHERE id = %s",
                [dataset_id],
            )
        return dataset


async def renew_check(connection: Connection, dataset_id: uuid.UUID) -> None:
    """Say that a dataset is still being validated."""
    await connection.execute(
        "UPDATE datasets SET used_at = now() WHERE id = %s AND state = 'checking'", [dataset_id]
    )


async def end_check(
    connection: Connection,
    dataset_id: uuid.UUID,
    *,
    sound: bool,
    has_poses: bool = False,
    photographs: int = 0,
    facts: Mapping[str, Any] | None = None,
) -> Dataset:
    """Commit a dataset that was found sound, or open it again for better files.

    Raises:
        Missing: there is no such dataset any more.
    """
    await connection.execute(
        """
        UPDATE datasets SET state = CASE WHEN %(sound)s THEN 'committed' ELSE 'open' END,
            committed_at = CASE WHEN %(sound)s THEN now() END, has_poses = %(poses)s,
            photographs = %(photographs)s, facts = %(facts)s
        WHERE id = %(id)s AND state = 'checking'
        """,
        {
            "sound": sound,
            "poses": has_poses,
            "photographs": photographs,
            "facts": Jsonb(dict(facts or {})),
            "id": dataset_id,
        },
    )
    dataset = await get_dataset(connection, dataset_id)
    if dataset is None:
        raise Missing("dataset")
    return dataset


async def change_dataset(
    connection: Connection, dataset_id: uuid.UUID, *, name: str, pinned: bool
) -> Dataset:
    """Rename a dataset, or keep it whatever its age."""
    await connection.execute(
        """
        UPDATE datasets SET name = %(name)s, pinned = %(pinned)s,
            expires_at = CASE WHEN %(pinned)s THEN NULL ELSE expires_at END
        WHERE id = %(id)s
        """,
        {"name": name, "pinned": pinned, "id": dataset_id},
    )
    dataset = await get_dataset(connection, dataset_id)
    if dataset is None:
        raise Missing("dataset")
    return dataset


async def delete_dataset(connection: Connection, dataset_id: uuid.UUID) -> None:
    """Forget a dataset that no job needs; its blobs stay until they are swept.

    Raises:
        Conflict: jobs were made from it, or it is being validated.
        Missing: there is no such dataset.
    """
    async with connection.transaction():
        dataset = await get_dataset(connection, dataset_id, lock=True)
        if dataset is None:
            raise Missing("dataset")
        if dataset.state == "checking" and not await _check_was_lost(connection, dataset_id):
            raise Conflict("The dataset is being checked; delete it when that is done.")
        cursor = await connection.execute(
            "SELECT count(*) AS n FROM jobs WHERE %s IN (dataset_id, files_id)", [dataset_id]
        )
        row = await cursor.fetchone()
        if row and row["n"]:
            raise Conflict(f"{row['n']} jobs were made from this dataset; delete them first.")
        await connection.execute("DELETE FROM datasets WHERE id = %s", [dataset_id])


async def _check_was_lost(connection: Connection, dataset_id: uuid.UUID) -> bool:
    """Whether whoever checks was not heard of for so long that it must have gone."""
    cursor = await connection.execute(
        "SELECT used_at < now() - make_interval(secs => %s) AS lost FROM datasets WHERE id = %s",
        [CHECK_LOST_SECONDS, dataset_id],
    )
    row = await cursor.fetchone()
    return bool(row and row["lost"])


async def _open_dataset(connection: Connection, dataset_id: uuid.UUID) -> Dataset:
    dataset = await get_dataset(connection, dataset_id, lock=True)
    if dataset is None:
        raise Missing("dataset")
    if dataset.state != "open":
        raise Conflict(f"The dataset is {dataset.state}, so its files do not change; make a new dataset.")
    return dataset
