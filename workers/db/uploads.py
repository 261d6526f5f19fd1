"""Uploads of one large file each, whose parts are kept until the whole is there."""

import uuid
from dataclasses import dataclass
from datetime import datetime

from octasplat.workers.db.connections import Connection, fetch_all, fetch_one
from octasplat.workers.db.errors import ConflictError
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.locks import lock_owner

KEPT_HOURS = 72
"""For so long an upload of which nothing more comes is kept."""


@dataclass(frozen=True)
class FileUpload:
    """An upload of one file.

    Attributes:
        id: UUIDv7.
        dataset_id: where the file belongs.
        owner: of the dataset.
        path: name of the file there; None for a ZIP file that is unpacked.
        size_bytes: its length.
        sha256: its digest, if it was announced.
        metadata: what the client said of it, as it said it.
        offset_bytes: how much of it has come.
        task_id: the newest task that stores the file, once all of it has come.
        expires_at: when it is given up unless more comes.
    """

    id: uuid.UUID
    dataset_id: uuid.UUID
    owner: str
    path: str | None
    size_bytes: int
    sha256: str | None
    metadata: str
    offset_bytes: int
    task_id: uuid.UUID | None
    created_at: datetime
    expires_at: datetime


@dataclass(frozen=True)
class UploadPart:
    """A part of an upload: where it begins, and its content."""

    start_bytes: int
    sha256: str
    size_bytes: int


async def add_upload(
    connection: Connection,
    dataset_id: uuid.UUID,
    owner: str,
    *,
    path: str | None,
    size_bytes: int,
    sha256: str | None,
    metadata: str,
) -> uuid.UUID:
    """Add an upload of which nothing has come; returns its id."""
    upload_id = new_id()
    await connection.execute(
        """
        INSERT INTO uploads (id, dataset_id, owner, path, size_bytes, sha256, metadata, expires_at)
        VALUES (%s, %s, %s, %s, %s, %s, %s, now() + make_interval(hours => %s))
        """,
        [upload_id, dataset_id, owner, path, size_bytes, sha256, metadata, KEPT_HOURS],
    )
    return upload_id


async def get_upload(
    connection: Connection, upload_id: uuid.UUID, *, lock: bool = False
) -> FileUpload | None:
    """Return the upload of that id, or None."""
    query = "SELECT {} FROM uploads WHERE id = %s"
    return await fetch_one(connection, FileUpload, f"{query} FOR UPDATE" if lock else query, [upload_id])


async def count_uploads(connection: Connection, owner: str) -> int:
    """Return how many uploads of an owner are unfinished."""
    cursor = await connection.execute("SELECT count(*) AS n FROM uploads WHERE owner = %s", [owner])
    row = await cursor.fetchone()
    assert row is not None
    return int(row["n"])


async def parts_of(connection: Connection, upload_id: uuid.UUID) -> list[UploadPart]:
    """Return the parts of an upload in their order, each beginning where the one before ends or later."""
    query = "SELECT {} FROM upload_parts WHERE upload_id = %s ORDER BY start_bytes"
    parts = list[UploadPart]()
    end_bytes = 0
    for part in await fetch_all(connection, UploadPart, query, [upload_id]):
        # A front end of the former version leaves those that came out of order beside what it puts there.
        if part.start_bytes >= end_bytes:
            parts.append(part)
            end_bytes = part.start_bytes + part.size_bytes
    return parts


async def add_part(connection: Connection, upload: FileUpload, part: UploadPart) -> None:
    """Add the next part of an upload.

    Raises:
        ConflictError: another part begins there, as by another connection, or the upload is gone.
    """
    await lock_owner(connection, upload.owner)
    # Only where the part begins at the end of what has come: of two connections one changes no row.
    cursor = await connection.execute(
        """
        UPDATE uploads SET offset_bytes = offset_bytes + %s, expires_at = now() + make_interval(hours => %s)
        WHERE id = %s AND offset_bytes = %s
        """,
        [part.size_bytes, KEPT_HOURS, upload.id, part.start_bytes],
    )
    if not cursor.rowcount:
        raise ConflictError("The upload was continued by somebody else; ask for its offset.")
    # Those that came out of order may begin within this one.
    await connection.execute(
        "DELETE FROM upload_parts WHERE upload_id = %s AND start_bytes >= %s", [upload.id, part.start_bytes]
    )
    await _insert_part(connection, upload, part)


async def put_part(connection: Connection, upload: FileUpload, part: UploadPart) -> None:
    """Put a part anywhere behind what has come in order; a repetition of one that has come changes nothing.

    Raises:
        ConflictError: other content has come there, or the upload is gone.
    """
    await lock_owner(connection, upload.owner)
    found = await get_upload(connection, upload.id, lock=True)
    if found is None:
        raise ConflictError("The upload is over; begin another one.")
    known = await fetch_one(
        connection,
        UploadPart,
        "SELECT {} FROM upload_parts WHERE upload_id = %s AND start_bytes = %s",
        [upload.id, part.start_bytes],
    )
    if known != part:
        if part.start_bytes < found.offset_bytes:
            raise ConflictError(f"{found.offset_bytes} bytes of the upload have come; go on behind them.")
        # Replaced by two statements, as both the one that goes and the one that comes are counted.
        await connection.execute(
            "DELETE FROM upload_parts WHERE upload_id = %s AND start_bytes = %s",
            [upload.id, part.start_bytes],
        )
        await _insert_part(connection, upload, part)
    offset = found.offset_bytes
    for start, size in await parts_ahead(connection, found):
        if start != offset:
            break
        offset += size
    await connection.execute(
        "UPDATE uploads SET offset_bytes = %s, expires_at = now() + make_interval(hours => %s) WHERE id = %s",
        [offset, KEPT_HOURS, upload.id],
    )


async def parts_ahead(connection: Connection, upload: FileUpload) -> list[tuple[int, int]]:
    """Return where parts begin that have come out of order, with their lengths, in their order."""
    cursor = await connection.execute(
        """
        SELECT start_bytes, size_bytes FROM upload_parts
        WHERE upload_id = %s AND start_bytes >= %s ORDER BY start_bytes
        """,
        [upload.id, upload.offset_bytes],
    )
    return [(row["start_bytes"], row["size_bytes"]) for row in await cursor.fetchall()]


async def _insert_part(connection: Connection, upload: FileUpload, part: UploadPart) -> None:
    await connection.execute(
        """
        INSERT INTO upload_parts (upload_id, start_bytes, owner, sha256, size_bytes)
        VALUES (%s, %s, %s, %s, %s)
        """,
        [upload.id, part.start_bytes, upload.owner, part.sha256, part.size_bytes],
    )


async def set_task(connection: Connection, upload_id: uuid.UUID, task_id: uuid.UUID) -> None:
    """Say which task stores the file of an upload."""
    await connection.execute("UPDATE uploads SET task_id = %s WHERE id = %s", [task_id, upload_id])


async def delete_upload(connection: Connection, upload: FileUpload) -> None:
    """Delete an upload with its parts, if it is there."""
    await lock_owner(connection, upload.owner)
    await connection.execute("DELETE FROM uploads WHERE id = %s", [upload.id])


async def delete_expired_uploads(connection: Connection) -> None:
    """Delete uploads of which nothing has come for long, but for those that are about to be stored."""
    cursor = await connection.execute("SELECT DISTINCT owner FROM uploads WHERE expires_at < now()")
    for row in await cursor.fetchall():
        async with connection.transaction():
            await lock_owner(connection, row["owner"])
            await connection.execute(
                """
                DELETE FROM uploads WHERE owner = %s AND expires_at < now() AND NOT EXISTS (
                    SELECT FROM dataset_tasks WHERE id = uploads.task_id AND state IN ('queued', 'running')
                )
                """,
                [row["owner"]],
            )
