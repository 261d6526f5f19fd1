"""References from the tables to content of the storage."""

from collections.abc import AsyncIterator
from typing import Any

from octasplat.workers.db.connections import Connection
from octasplat.workers.storage.fsck import Reference


async def references(connection: Connection) -> AsyncIterator[Reference]:
    """Return the references of datasets, uploads, results, checkpoints, previews and live scenes."""
    async with connection.transaction():
        # Named cursors stay on the server and send rows in parts, as the tables may be larger than the
        # memory.
        async with connection.cursor("dataset_files") as cursor:
            await cursor.execute("SELECT dataset_id, path, sha256, size_bytes FROM dataset_files")
            async for row in cursor:
                yield Reference(
                    f"dataset {row['dataset_id']} {row['path']}", row["sha256"], row["size_bytes"]
                )
        async with connection.cursor("upload_parts") as cursor:
            await cursor.execute("SELECT upload_id, sha256, size_bytes FROM upload_parts")
            async for row in cursor:
                yield Reference(f"upload {row['upload_id']}", row["sha256"], row["size_bytes"])
        async with connection.cursor("artifacts") as cursor:
            await cursor.execute("SELECT job_id, name, sha256, size_bytes FROM artifacts")
            async for row in cursor:
                yield Reference(f"job {row['job_id']} {row['name']}", row["sha256"], row["size_bytes"])
        async with connection.cursor("job_states") as cursor:
            await cursor.execute(
                "SELECT id, checkpoint, preview FROM jobs WHERE checkpoint IS NOT NULL OR preview IS NOT NULL"
            )
            async for row in cursor:
                for reference in _job_references(row):
                    yield reference
        async with connection.cursor("live_scenes") as cursor:
            await cursor.execute("SELECT job_id, sha256, views_sha256 FROM live_scenes")
            async for row in cursor:
                for content in (row["sha256"], row["views_sha256"]):
                    yield Reference(f"job {row['job_id']} live scene", content)


def _job_references(row: dict[str, Any]) -> list[Reference]:
    found = [
        Reference(f"job {row['id']} checkpoint {file['path']}", file["sha256"], file["size_bytes"])
        for file in (row["checkpoint"] or {}).get("files", ())
    ]
    if row["preview"] is not None:
        found.append(Reference(f"job {row['id']} preview", row["preview"]["sha256"]))
    return found
