"""Datasets and their files in the tables."""

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from psycopg.rows import class_row, dict_row

from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.workers.db.connections import Connection, fetch_all, fetch_one, select_columns
from octasplat.workers.db.errors import ConflictError, NotFoundError
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.postgres_text import as_json
from octasplat.workers.db.rows import Dataset, DatasetFile, DatasetHolds

STALE_CHECK_SECONDS = 60
"""A validation of which nothing was heard for so long counts no more; its process is gone."""


async def create_dataset(
    connection: Connection, owner: str, name: str, holds: DatasetHolds = "photographs"
) -> Dataset:
    """Return a new dataset that takes files."""
    dataset_id = new_id()
    await connection.execute(
        "INSERT INTO datasets (id, owner, name, holds) VALUES (%s, %s, %s, %s)",
        [dataset_id, owner, name, holds],
    )
    dataset = await get_dataset(connection, dataset_id)
    assert dataset is not None
    return dataset


async def get_dataset(connection: Connection, dataset_id: uuid.UUID, *, lock: bool = False) -> Dataset | None:
    """Return the dataset of that id, or None."""
    query = "SELECT {} FROM datasets WHERE id = %s"
    return await fetch_one(connection, Dataset, f"{query} FOR UPDATE" if lock else query, [dataset_id])


async def list_datasets(
    connection: Connection, *, owner: str | None = None, before: uuid.UUID | None = None, limit: int = 50
) -> list[Dataset]:
    """Return datasets, newest first; ``owner`` None takes those of all owners."""
    return await fetch_all(
        connection,
        Dataset,
        """
            SELECT {} FROM datasets
            WHERE (%(owner)s::text IS NULL OR owner = %(owner)s)
              AND (%(before)s::uuid IS NULL OR id < %(before)s)
            ORDER BY id DESC LIMIT %(limit)s
            """,
        {"owner": owner, "before": before, "limit": limit},
    )


@dataclass(frozen=True)
class DatasetSize:
    """Size of a dataset: the bytes of its files, and the jobs that work on it."""

    id: uuid.UUID
    bytes: int
    jobs: int


async def dataset_sizes(connection: Connection, ids: Sequence[uuid.UUID]) -> dict[uuid.UUID, DatasetSize]:
    """Return what each of these datasets takes."""
    async with connection.cursor(row_factory=class_row(DatasetSize)) as cursor:
        await cursor.execute(
            """
            SELECT wanted.id,
                (SELECT coalesce(sum(size_bytes), 0)::bigint FROM dataset_files WHERE dataset_id = wanted.id)
                    AS bytes,
                (SELECT count(*) FROM jobs WHERE dataset_id = wanted.id AND root_id IS NULL) AS jobs
            FROM unnest(%s::uuid[]) AS wanted(id)
            """,
            [list(ids)],
        )
        return {row.id: row for row in await cursor.fetchall()}


async def list_files_by_suffix(
    connection: Connection, owner: str, suffixes: Sequence[str], *, limit: int
) -> list[tuple[Dataset, str]]:
    """Return files that options may name, by suffix, with their committed datasets; newest first."""
    async with connection.cursor(row_factory=dict_row) as cursor:
        await cursor.execute(
            select_columns(
                """
            SELECT f.path AS file_path, {} FROM datasets d JOIN dataset_files f ON f.dataset_id = d.id
            WHERE d.owner = %s AND d.holds = 'files' AND d.state = 'committed'
              AND lower(f.path) LIKE ANY(%s)
            ORDER BY d.id DESC, f.path LIMIT %s
            """,
                Dataset,
                "d",
            ),
            [owner, [f"%{ending}" for ending in suffixes], limit],
        )
        # The condition is evaluated first, and takes out the column that Dataset has no field for.
        return [(Dataset(**row), path) for row in await cursor.fetchall() if (path := row.pop("file_path"))]


@dataclass(frozen=True)
class NewFile:
    """A file that has arrived, see :class:`octasplat.workers.db.rows.DatasetFile`."""

    path: str
    sha256: str
    size_bytes: int
    facts: Mapping[str, Any] = field(default_factory=dict)


async def put_files(
    connection: Connection, dataset_id: uuid.UUID, files: Sequence[NewFile]
) -> list[DatasetFile]:
    """Record uploaded files, each replacing one of the same path; by path.

    All go in one statement, as the locks of the dataset and its owner are held for as long as it takes.

    Raises:
        ConflictError: the dataset takes no files any more.
        NotFoundError: there is no such dataset.
    """
    async with connection.transaction():
        await _lock_open_dataset(connection, dataset_id)
        async with connection.cursor(row_factory=class_row(DatasetFile)) as cursor:
            await cursor.execute(
                select_columns(
                    """
            INSERT INTO dataset_files (dataset_id, path, sha256, size_bytes, facts)
            SELECT %s, given.path, given.sha256, given.size_bytes, given.facts
            FROM unnest(%s::text[], %s::text[], %s::bigint[], %s::jsonb[])
                AS given (path, sha256, size_bytes, facts) ORDER BY given.path COLLATE "C"
            ON CONFLICT (dataset_id, path) DO UPDATE
            SET sha256 = excluded.sha256, size_bytes = excluded.size_bytes, facts = excluded.facts,
                uploaded_at = now()
            RETURNING {}
            """,
                    DatasetFile,
                    "dataset_files",
                ),
                [
                    dataset_id,
                    [file.path for file in files],
                    [file.sha256 for file in files],
                    [file.size_bytes for file in files],
                    [as_json(dict(file.facts)) for file in files],
                ],
            )
            return sorted(await cursor.fetchall(), key=lambda file: file.path)


async def put_file(
    connection: Connection,
    dataset_id: uuid.UUID,
    path: str,
    sha256: str,
    size_bytes: int,
    facts: Mapping[str, Any] | None = None,
) -> DatasetFile:
    """Record one file; as :func:`put_files`."""
    [file] = await put_files(connection, dataset_id, [NewFile(path, sha256, size_bytes, facts or {})])
    return file


async def remove_file(connection: Connection, dataset_id: uuid.UUID, path: str) -> bool:
    """Take a file out of an open dataset; False if there was none.

    Raises:
        ConflictError: the dataset does not change any more.
        NotFoundError: there is no such dataset.
    """
    async with connection.transaction():
        await _lock_open_dataset(connection, dataset_id)
        cursor = await connection.execute(
            "DELETE FROM dataset_files WHERE dataset_id = %s AND path = %s", [dataset_id, path]
        )
        return cursor.rowcount > 0


async def get_file(connection: Connection, dataset_id: uuid.UUID, path: str) -> DatasetFile | None:
    """Return one file of a dataset, or None."""
    return await fetch_one(
        connection,
        DatasetFile,
        "SELECT {} FROM dataset_files WHERE dataset_id = %s AND path = %s",
        [dataset_id, path],
    )


async def files_of(
    connection: Connection, dataset_id: uuid.UUID, *, after: str = "", limit: int | None = None
) -> list[DatasetFile]:
    """Return at most ``limit`` files of a dataset after the path ``after``, by path."""
    # By bytes, which is Python's order of paths too, whatever the locale of the database.
    return await fetch_all(
        connection,
        DatasetFile,
        """
            SELECT {} FROM dataset_files WHERE dataset_id = %s AND path COLLATE "C" > %s
            ORDER BY path COLLATE "C" LIMIT %s
            """,
        [dataset_id, after, limit],
    )


async def photograph_sizes(connection: Connection, dataset_id: uuid.UUID) -> list[ImageSizes]:
    """Return how many photographs of which size a dataset has, of those whose size is known."""
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
    return [ImageSizes(row["width"], row["height"], row["n"]) for row in await cursor.fetchall()]


async def change_dataset(
    connection: Connection, dataset_id: uuid.UUID, *, name: str, pinned: bool
) -> Dataset:
    """Rename a dataset, or pin it so that it does not expire."""
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
        raise NotFoundError("dataset")
    return dataset


async def delete_dataset(connection: Connection, dataset_id: uuid.UUID) -> None:
    """Delete a dataset that no job needs; its blobs stay until they are collected.

    Raises:
        ConflictError: jobs were made from it, or it is being validated.
        NotFoundError: there is no such dataset.
    """
    async with connection.transaction():
        await _lock_owner_of(connection, dataset_id)
        dataset = await get_dataset(connection, dataset_id, lock=True)
        if dataset is None:
            raise NotFoundError("dataset")
        if dataset.state == "checking" and not await is_check_stale(connection, dataset_id):
            raise ConflictError("The dataset is being checked; delete it when that is done.")
        cursor = await connection.execute(
            "SELECT count(*) AS n FROM jobs WHERE %s IN (dataset_id, files_id)", [dataset_id]
        )
        row = await cursor.fetchone()
        if row and row["n"]:
            raise ConflictError(f"{row['n']} jobs were made from this dataset; delete them first.")
        await connection.execute("DELETE FROM datasets WHERE id = %s", [dataset_id])


async def is_check_stale(connection: Connection, dataset_id: uuid.UUID) -> bool:
    """Return whether a validation has not been renewed for so long that its process must be gone."""
    cursor = await connection.execute(
        "SELECT used_at < now() - make_interval(secs => %s) AS lost FROM datasets WHERE id = %s",
        [STALE_CHECK_SECONDS, dataset_id],
    )
    row = await cursor.fetchone()
    return bool(row and row["lost"])


async def _lock_owner_of(connection: Connection, dataset_id: uuid.UUID) -> None:
    """Take the owner's lock, before that of the dataset; see :mod:`octasplat.workers.db.locks`."""
    dataset = await get_dataset(connection, dataset_id)
    if dataset is None:
        raise NotFoundError("dataset")
    await lock_owner(connection, dataset.owner)


async def _lock_open_dataset(connection: Connection, dataset_id: uuid.UUID) -> Dataset:
    await _lock_owner_of(connection, dataset_id)
    dataset = await get_dataset(connection, dataset_id, lock=True)
    if dataset is None:
        raise NotFoundError("dataset")
    if dataset.state != "open":
        raise ConflictError(
            f"The dataset is {dataset.state}, so its files do not change; make a new dataset."
        )
    return dataset
