"""Tables are brought up to date while others use them, and what was miscounted is counted anew."""

import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from click.testing import CliRunner
from psycopg.types.json import Jsonb

from octasplat.workers.cli.commands.fsck import fsck as fsck_command
from octasplat.workers.db import migrate as migrating
from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.datasets import NewFile, create_dataset, put_files
from octasplat.workers.db.errors import DatabaseError
from octasplat.workers.db.migrate import OWN_COMPONENT, all_migrations, migrate
from octasplat.workers.maintenance.backup import create_backup
from octasplat.workers.postgres.embedded import EmbeddedPostgres
from octasplat.workers.storage.local import LocalStorage
from tests.support.postgres_fixtures import copied_database

STEPS = [step.name for step in all_migrations() if step.component == OWN_COMPONENT]
BEFORE_USAGE = [name for name in STEPS if name < "0008"]
BEFORE_LOCKS = [name for name in STEPS if name < "0012"]
BEFORE_NUMBERS = [name for name in STEPS if name < "0016"]
BEFORE_BLOCKS = [name for name in STEPS if name < "0023"]


@pytest.fixture
def empty(postgres: EmbeddedPostgres) -> Iterator[str]:
    with copied_database(postgres, "template0") as copied:
        yield copied


def usage(connection: "psycopg.Connection[tuple[int, ...]]") -> int:
    row = connection.execute("SELECT coalesce(sum(bytes), 0)::bigint FROM owner_usage").fetchone()
    assert row is not None
    return row[0]


def fill(connection: "psycopg.Connection[tuple[int, ...]]") -> None:
    dataset, job = uuid.uuid4(), uuid.uuid4()
    connection.execute("INSERT INTO datasets (id, owner, name) VALUES (%s, 'me', 'a')", [dataset])
    add = "INSERT INTO dataset_files (dataset_id, path, sha256, size_bytes) VALUES (%s, %s, %s, %s)"
    for number in range(3):
        connection.execute(add, [dataset, f"images/{number}.jpg", f"{number % 2:064x}", 100])
    checkpoint = {"files": [{"path": "a", "sha256": "c" * 64, "size_bytes": 7}]}
    connection.execute(
        "INSERT INTO jobs (id, owner, kind, options, queue, state) "
        "VALUES (%s, 'me', 'x', '{}', 'cpu', 'failed')",
        [job],
    )
    connection.execute("UPDATE jobs SET checkpoint = %s", [Jsonb(checkpoint)])
    connection.execute("INSERT INTO artifacts VALUES (%s, 'a', %s, 10, '')", [job, "d" * 64])


TRUTH = 2 * 100 + 7 + 10


@pytest.mark.parametrize("steps", [BEFORE_USAGE, BEFORE_LOCKS])
def test_old_database_usage_is_counted(empty: str, steps: list[str]) -> None:
    migrate(empty, only=steps)
    with psycopg.connect(empty) as connection:
        fill(connection)
        if steps == BEFORE_LOCKS:
            assert usage(connection) == TRUTH
            connection.execute("UPDATE owner_usage SET bytes = bytes - 20000000")
            connection.execute("DELETE FROM owner_contents WHERE size_bytes = 100")
    assert migrate(empty)[-1] == STEPS[-1]
    with psycopg.connect(empty) as connection:
        assert usage(connection) == TRUTH
        connection.execute("DELETE FROM jobs")
        connection.execute("DELETE FROM datasets")
        assert usage(connection) == 0
        assert connection.execute("SELECT count(*) FROM owner_contents").fetchone() == (0,)


def test_uploads_beside_the_counting_are_counted(empty: str) -> None:
    migrate(empty, only=BEFORE_USAGE)
    dataset = uuid.uuid4()
    with psycopg.connect(empty) as uploading:
        uploading.execute("INSERT INTO datasets (id, owner, name) VALUES (%s, 'me', 'a')", [dataset])
        uploading.commit()
        add = (
            "INSERT INTO dataset_files (dataset_id, path, sha256, size_bytes) VALUES (%s, 'a', %s, 20000000)"
        )
        uploading.execute(add, [dataset, "a" * 64])
        upgrading = threading.Thread(target=migrate, args=(empty,))
        upgrading.start()
        time.sleep(1.0)
        uploading.commit()
        upgrading.join(60)
    with psycopg.connect(empty) as connection:
        assert usage(connection) == 20_000_000
        connection.execute("DELETE FROM datasets")
        assert usage(connection) == 0


def test_events_and_lines_of_both_versions_are_numbered_by_job(empty: str) -> None:
    migrate(empty, only=BEFORE_NUMBERS)
    jobs = [uuid.uuid4(), uuid.uuid4()]
    add_event = "INSERT INTO job_events (job_id, attempt, kind, data) VALUES (%s, 1, 'progress', '{}')"
    add_lines = "INSERT INTO job_logs (job_id, attempt, text) SELECT %s, 1, unnest(%s::text[])"

    def add(connection: "psycopg.Connection[tuple[int, ...]]") -> None:
        for job in jobs:
            connection.execute(add_event, [job])
            connection.execute(add_lines, [job, ["a", "b"]])

    with psycopg.connect(empty) as connection:
        for job in jobs:
            connection.execute(
                "INSERT INTO jobs (id, owner, kind, options, queue) VALUES (%s, 'me', 'x', '{}', 'cpu')",
                [job],
            )
        add(connection)
        add(connection)
    migrate(empty, only=[name for name in STEPS if name <= "0016_numbers.sql"])
    with psycopg.connect(empty) as connection:
        add(connection)  # between the two steps, and after them, by a process of the former version
    migrate(empty)
    with psycopg.connect(empty) as connection:
        add(connection)
        for table, count in (("job_events", 4), ("job_logs", 8)):
            for job in jobs:
                rows = connection.execute(
                    f"SELECT number FROM {table} WHERE job_id = %s ORDER BY id".encode(), [job]
                ).fetchall()
                assert [number for (number,) in rows] == list(range(1, count + 1))


def test_jobs_of_the_last_version_are_whole_jobs(empty: str) -> None:
    migrate(empty, only=BEFORE_BLOCKS)
    with psycopg.connect(empty) as connection:
        fill(connection)
    assert migrate(empty)[0] == "0023_blocks.sql"
    with psycopg.connect(empty) as connection:
        fill(connection)  # by a process of the former version
        roles = connection.execute("SELECT root_id, role FROM jobs").fetchall()
        assert roles == [(None, None)] * 2
        assert usage(connection) == TRUTH
        root = connection.execute("SELECT id FROM jobs").fetchone()
        assert root is not None
        connection.execute(
            "INSERT INTO jobs (id, owner, kind, options, queue, root_id, role) "
            "VALUES (%s, 'me', 'x', '{}', 'cpu', %s, 'block')",
            [(block := uuid.uuid4()), root[0]],
        )
        connection.execute("INSERT INTO job_needs VALUES (%s, %s)", [root[0], block])
        connection.execute("INSERT INTO artifacts VALUES (%s, 'a', %s, 10, '')", [block, "e" * 64])
        connection.execute("DELETE FROM jobs WHERE role IS NULL")
        assert connection.execute("SELECT count(*) FROM jobs").fetchone() == (0,)
        assert connection.execute("SELECT count(*) FROM job_needs").fetchone() == (0,)
        assert usage(connection) == 2 * 100


def test_fsck_recount_corrects_usage(conninfo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DATABASE_URL", conninfo)
    monkeypatch.setenv("OCTASPLAT_STORAGE", str(tmp_path / "store"))
    LocalStorage(tmp_path / "store", floor_bytes=0).close()
    with psycopg.connect(conninfo) as connection:
        connection.execute("INSERT INTO owner_usage VALUES ('me', 0, -20000000)")
    told = CliRunner().invoke(fsck_command, ["--recount"])
    assert told.exit_code == 0 and "me: -20000000 bytes were counted; 0 it is" in told.output, told.output
    again = CliRunner().invoke(fsck_command, ["--recount"])
    assert "were counted" not in again.output
    with psycopg.connect(conninfo) as connection:
        assert usage(connection) == 0


def test_migration_waiting_for_lock_does_not_block_others(
    empty: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(migrating, "LOCK_TIMEOUT_SECONDS", 0.5)
    migrate(empty, only=BEFORE_LOCKS)
    longest = 0.0
    with psycopg.connect(empty) as reading, psycopg.connect(empty, autocommit=True) as serving:
        reading.execute("SELECT count(*) FROM datasets")
        reading.execute("SELECT count(*) FROM dataset_files")  # as of a backup's snapshot
        upgrading = threading.Thread(target=migrate, args=(empty,))
        upgrading.start()
        deadline = time.monotonic() + 3
        while time.monotonic() < deadline:
            began = time.monotonic()
            serving.execute("SELECT count(*) FROM dataset_files")
            serving.execute("DELETE FROM dataset_files WHERE path = 'none'")
            longest = max(longest, time.monotonic() - began)
            time.sleep(0.02)
        assert upgrading.is_alive()
        reading.rollback()
        upgrading.join(60)
    assert not upgrading.is_alive() and longest < 2.5
    assert migrate(empty) == ()


def test_locked_tables_are_named(empty: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(migrating, "LOCK_TIMEOUT_SECONDS", 0.1)
    monkeypatch.setattr(migrating, "MAX_WAIT_SECONDS", 0.5)
    migrate(empty, only=BEFORE_LOCKS)
    with psycopg.connect(empty) as holding:
        holding.execute("LOCK TABLE dataset_files IN ACCESS SHARE MODE")
        with pytest.raises(DatabaseError, match=r"0012_locks.sql.*such as a backup"):
            migrate(empty)
    with psycopg.connect(empty, autocommit=True) as other:
        other.execute("SELECT pg_advisory_lock(%s)", [migrating._LOCK])
        with pytest.raises(DatabaseError, match=r"Another process has changed the tables for 0\.5 s"):
            migrate(empty)
    assert migrate(empty) == tuple(STEPS[len(BEFORE_LOCKS) :])


async def test_backup_locks_no_table_during_copy(conninfo: str, tmp_path: Path) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    with storage.open_writer() as writer:
        writer.write(b"a photograph")
        blob = writer.commit()

    def upgrade(_done: int, _count: int) -> None:
        with psycopg.connect(conninfo) as connection:
            connection.execute("SET lock_timeout = '2s'")
            connection.execute("ALTER TABLE datasets ADD COLUMN further text")

    async with open_pool(conninfo) as pool:
        async with pool.connection() as connection:
            dataset = await create_dataset(connection, "me", "a")
        async with pool.connection() as connection:
            await put_files(connection, dataset.id, [NewFile("images/a.jpg", blob.sha256, 12)])
    assert create_backup(conninfo, storage, tmp_path / "backup", on_content=upgrade).contents == 1


async def test_many_file_archive_is_recorded_quickly(conninfo: str) -> None:
    """12,000 of them; others of the same owner wait no longer than that."""
    files = [NewFile(f"images/{n}.jpg", f"{n:064x}", 10, {"width_px": n}) for n in range(12_000)]

    async with open_pool(conninfo) as pool:
        async with pool.connection() as connection:
            dataset = await create_dataset(connection, "me", "a")
        for again in range(2):
            began = time.monotonic()
            async with pool.connection() as connection:
                rows = await put_files(connection, dataset.id, files)
            took = time.monotonic() - began
            assert len(rows) == 12_000 and rows[0].path == "images/0.jpg", again
        with psycopg.connect(conninfo) as connection:
            assert usage(connection) == 120_000
    assert took < 12  # it was 24 s for as many on an idle machine
