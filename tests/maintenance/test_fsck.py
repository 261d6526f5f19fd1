"""fsck reports what a restore, a lost disk or a flipped bit left behind, and touches nothing."""

import asyncio
import json
import os
import time
import uuid
from pathlib import Path

import pytest
from click.testing import CliRunner
from psycopg.types.json import Jsonb

from octasplat.workers.cli.commands.fsck import fsck
from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.datasets import create_dataset, put_file
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.storage.local import LocalStorage


def put(storage: LocalStorage, data: bytes, age_seconds: float = 0) -> str:
    with storage.open_writer() as writer:
        writer.write(data)
        sha256 = writer.commit().sha256
    path = storage.local_path(sha256)
    assert path is not None
    os.utime(path, (time.time() - age_seconds,) * 2)
    return sha256


@pytest.fixture
def store(tmp_path: Path, conninfo: str, monkeypatch: pytest.MonkeyPatch) -> LocalStorage:
    """A store beside a table that names a photograph, a result, a checkpoint and a preview in it."""
    monkeypatch.setenv("DATABASE_URL", conninfo)
    monkeypatch.setenv("OCTASPLAT_STORAGE", str(tmp_path / "store"))
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    contents = {name: put(storage, name.encode()) for name in ("photo", "result", "state", "preview")}

    async def fill() -> None:
        async with open_pool(conninfo) as pool, pool.connection() as connection:
            dataset = await create_dataset(connection, "me", "a")
            await connection.commit()
            await put_file(connection, dataset.id, "images/a.jpg", contents["photo"], 5)
            checkpoint = {"files": [{"path": "run/x", "sha256": contents["state"], "size_bytes": 5}]}
            await connection.commit()
            await lock_owner(connection, "me")
            job_id = uuid.uuid4()
            await connection.execute(
                "INSERT INTO jobs (id, owner, kind, options, queue, checkpoint, preview) "
                "VALUES (%s, 'me', 'x', '{}', 'cpu', %s, %s)",
                [job_id, Jsonb(checkpoint), Jsonb({"sha256": contents["preview"]})],
            )
            await connection.execute(
                "INSERT INTO artifacts (job_id, name, sha256, size_bytes, media_type) "
                "VALUES (%s, 'scene.ply', %s, 6, '')",
                [job_id, contents["result"]],
            )

    asyncio.run(fill())
    return storage


def damage(storage: LocalStorage, content: str) -> Path:
    """The file of a content, made writable."""
    for entry in storage.list_blobs():
        path = storage.local_path(entry.blob.sha256)
        assert path is not None
        if path.read_bytes() == content.encode():
            path.chmod(0o600)
            return path
    raise AssertionError(content)


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(fsck, arguments)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.output


def test_fsck_of_complete_store_finds_nothing(store: LocalStorage) -> None:
    code, output = run("--verify")
    assert code == 0
    assert "4 places in the tables, 4 contents of 23 bytes in the store, 4 of them read whole." in output
    assert "Everything that is named is there." in output


@pytest.mark.parametrize("content", ["photo", "result", "state", "preview"])
def test_missing_content_is_named(store: LocalStorage, content: str) -> None:
    damage(store, content).unlink()
    code, output = run()
    where = {
        "photo": "images/a.jpg",
        "result": "scene.ply",
        "state": "checkpoint run/x",
        "preview": "preview",
    }
    assert code == 1
    assert output.startswith("missing: ") and where[content] in output.splitlines()[0]


def test_fsck_verify_finds_damaged_content(store: LocalStorage) -> None:
    damage(store, "photo").write_bytes(b"PHOTO")
    assert run()[0] == 0
    code, output = run("--verify")
    assert code == 1 and output.startswith("damaged: ") and "images/a.jpg" in output
    damage(store, "result").write_bytes(b"short")
    assert "size: " in run()[1]


def test_fsck_keeps_unreferenced_content(store: LocalStorage) -> None:
    old, young = put(store, b"old", age_seconds=7200), put(store, b"young")
    code, output = run("--json")
    report = json.loads(output)
    assert code == 0
    assert (report["unused"], report["unused_bytes"], report["young"]) == ([old], 3, 1)
    assert "1 contents of 3 bytes are named by nothing." in run()[1]
    assert {old, young} <= {entry.blob.sha256 for entry in store.list_blobs()}


def test_fsck_without_database_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DATABASE_URL", raising=False)
    result = CliRunner().invoke(fsck, ["--data", str(tmp_path)])
    assert result.exit_code == 1 and "holds no database" in str(result.exception)
