"""Photographs in the store and the tables of workers under test."""

import uuid
from pathlib import Path

from octasplat.workers.db.connections import Connection
from octasplat.workers.db.datasets import NewFile, create_dataset, put_files
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.storage.factory import open_storage
from tests.support.worker_harness import WorkerHarness


def store_dataset(bench: WorkerHarness, scene: Path) -> uuid.UUID:
    """Put the photographs into the store and the tables."""
    (bench.folder / "store").mkdir(exist_ok=True)
    storage = open_storage(bench.store)

    async def store(connection: Connection) -> uuid.UUID:
        await lock_owner(connection, "me")
        dataset = await create_dataset(connection, owner="me", name="tiny")
        files = []
        for path in sorted(path for path in scene.rglob("*") if path.is_file()):
            with storage.open_writer() as writer:
                writer.write(path.read_bytes())
                blob = writer.commit()
            files.append(NewFile(path.relative_to(scene).as_posix(), blob.sha256, path.stat().st_size))
        await put_files(connection, dataset.id, files)
        await connection.execute("UPDATE datasets SET state = 'committed', has_poses = true")
        return dataset.id

    found: uuid.UUID = bench.run_query(store)
    return found
