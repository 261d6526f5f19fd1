"""Tables are brought up to date once, from nothing and from what earlier versions left."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from octasplat.workers.db.errors import DatabaseError
from octasplat.workers.db.migrate import (
    all_migrations,
    migrate,
    missing_migrations,
    queue_migrations,
    wait_for_tables,
)
from octasplat.workers.postgres.embedded import EmbeddedPostgres
from tests.support.postgres_fixtures import copied_database

ROOT = Path(__file__).parents[2]


@pytest.fixture
def empty(postgres: EmbeddedPostgres) -> Iterator[str]:
    with copied_database(postgres, "template0") as copied:
        yield copied


def shape(conninfo: str) -> set[tuple[str, ...]]:
    """Tables, columns, functions and indexes."""
    with psycopg.connect(conninfo) as connection:
        columns = connection.execute(
            "SELECT table_name, column_name, data_type FROM information_schema.columns "
            "WHERE table_schema = 'public'"
        ).fetchall()
        functions = connection.execute(
            "SELECT proname, pg_get_function_identity_arguments(p.oid), 'function' FROM pg_proc p "
            "JOIN pg_namespace n ON n.oid = pronamespace WHERE nspname = 'public'"
        ).fetchall()
        indexes = connection.execute("SELECT indexname, '', 'index' FROM pg_indexes").fetchall()
    return {tuple(map(str, row)) for row in (*columns, *functions, *indexes)}


def test_migrate_twice_applies_nothing(empty: str) -> None:
    assert "0001_jobs.sql" in migrate(empty)
    assert migrate(empty) == ()
    with psycopg.connect(empty) as connection:
        rows = connection.execute("SELECT component, name FROM schema_steps").fetchall()
    assert missing_migrations({(str(a), str(b)) for a, b in rows}) == []


def test_starts_at_once_apply_every_step_once(empty: str) -> None:
    applied: list[tuple[str, ...]] = []
    threads = [threading.Thread(target=lambda: applied.append(migrate(empty))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(map(len, applied))[:3] == [0, 0, 0] and sum(map(len, applied)) >= 2


def test_database_of_an_earlier_queue_ends_the_same(empty: str, conninfo: str) -> None:
    """All but the last steps of the queue's library, as an earlier pin had left them, then the rest."""
    steps = queue_migrations()
    with psycopg.connect(empty, autocommit=True) as connection:
        connection.execute("CREATE TABLE schema_steps (component text, name text, applied_at timestamptz "
                           "NOT NULL DEFAULT now(), PRIMARY KEY (component, name))")  # fmt: skip
        for step in steps[:-6]:
            connection.execute(step.sql.encode())
            connection.execute("INSERT INTO schema_steps VALUES (%s, %s)", [step.component, step.name])
    assert migrate(empty)[:6] == tuple(step.name for step in steps[-6:])
    fresh, upgraded = shape(conninfo), shape(empty)
    assert fresh - upgraded == set()


def test_newer_compatible_database_is_accepted(empty: str) -> None:
    migrate(empty)
    with psycopg.connect(empty) as connection:
        connection.execute("INSERT INTO schema_steps VALUES ('octasplat', '9999_future.sql')")
    before = shape(empty)
    assert migrate(empty) == ()
    wait_for_tables(empty, seconds=0)
    with psycopg.connect(empty) as connection:
        (reach,) = connection.execute("SELECT oldest_reader FROM schema_reach").fetchall()
        connection.execute("UPDATE schema_reach SET oldest_reader = '9999_future.sql'")
    for use in (migrate, wait_for_tables):
        with pytest.raises(DatabaseError, match=r"newer version.*9999_future"):
            use(empty)
    assert shape(empty) == before and reach[0] in {step.name for step in all_migrations()}


@pytest.mark.exhaustive
def test_workers_and_read_commands_do_not_migrate(empty: str, tmp_path: Path) -> None:
    before = shape(empty)
    with pytest.raises(DatabaseError, match="octasplat migrate"):
        wait_for_tables(empty, seconds=0)
    environment = {**os.environ, "DATABASE_URL": empty, "OCTASPLAT_DATA": str(tmp_path)}

    def octasplat(*arguments: str) -> "subprocess.CompletedProcess[str]":
        command = [sys.executable, "-m", "octasplat", *arguments]
        return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)

    listed = octasplat("token", "list")
    assert listed.returncode == 1 and "octasplat migrate" in listed.stderr
    quota = octasplat("quota", "somebody")
    assert quota.returncode == 1 and "octasplat migrate" in quota.stderr
    assert shape(empty) == before
    assert "0001_jobs.sql" in octasplat("migrate").stdout
    assert octasplat("token", "list").returncode == 0
    assert "jobs: 0 of any number" in octasplat("quota", "somebody").stdout
    made = json.loads(octasplat("token", "create", "somebody", "--json").stdout)
    assert octasplat("token", "revoke", made["id"]).stdout == "Revoked.\n"
    again = octasplat("token", "revoke", made["id"])
    assert again.returncode == 1 and "octasplat token list" in again.stderr


def test_unreachable_database_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(DatabaseError, match="check DATABASE_URL"):
        migrate(f"host={tmp_path} dbname=x user=y")


def test_steps_have_an_order() -> None:
    names = [step.name for step in all_migrations() if step.component == "octasplat"]
    assert names == sorted(names) and len(names) == len(set(names))
