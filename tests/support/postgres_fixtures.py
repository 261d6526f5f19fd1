"""A private Postgres for the tests of the service, and a fresh database for each test."""

import functools
import os
import shutil
import signal
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psycopg
import pytest
from psycopg import sql
from psycopg.conninfo import make_conninfo

from octasplat.workers.db.migrate import migrate
from octasplat.workers.postgres.embedded import EmbeddedPostgres
from tests.support import lock_order_check


@pytest.fixture(scope="session")
def short_root() -> Iterator[Path]:
    """A folder that the database's user can reach, unlike pytest's own when root runs the tests."""
    root = Path(tempfile.mkdtemp(prefix="octasplat-tests-"))
    root.chmod(0o711)
    yield root
    shutil.rmtree(root, ignore_errors=True)


@pytest.fixture(scope="session")
def postgres(short_root: Path) -> Iterator[EmbeddedPostgres]:
    """A running private Postgres."""
    server = EmbeddedPostgres(short_root / "shared")
    server.start()
    with psycopg.connect(server.conninfo(), autocommit=True) as connection:
        connection.execute("ALTER SYSTEM SET fsync = off")
        connection.execute("SELECT pg_reload_conf()")
    yield server
    administration(server).close()
    # At once, as nothing here is worth the flushing.
    os.kill(int((server.cluster / "postmaster.pid").read_text().split()[0]), signal.SIGQUIT)


@pytest.fixture(scope="session")
def template(postgres: EmbeddedPostgres) -> str:
    """Name of a database with all tables, to be copied."""
    migrate(postgres.conninfo())
    return "octasplat"


@contextmanager
def copied_database(postgres: EmbeddedPostgres, template: str) -> Iterator[str]:
    """A new database made from ``template``, dropped at the end."""
    name = f"test_{uuid.uuid4().hex[:12]}"
    connection = administration(postgres)
    # Files are copied faster than pages, as nothing is flushed here.
    command = f'CREATE DATABASE "{name}" TEMPLATE "{template}" STRATEGY FILE_COPY'
    connection.execute(command.encode())
    yield make_conninfo(postgres.conninfo(), dbname=name)
    connection.execute(f'DROP DATABASE "{name}" WITH (FORCE)'.encode())


@functools.cache
def administration(postgres: EmbeddedPostgres) -> psycopg.Connection:
    """A connection that stays, as the first copy of a database costs it four times what the next ones do."""
    return psycopg.connect(make_conninfo(postgres.conninfo(), dbname="postgres"), autocommit=True)


@pytest.fixture
def conninfo(postgres: EmbeddedPostgres, template: str) -> Iterator[str]:
    """A database of the test's own, with all tables."""
    with copied_database(postgres, template) as copied:
        lock_order_check.install_lock_order_checks(copied)
        yield copied


def add_columns(conninfo: str) -> None:
    """Give every table of ours a further column, as the next version may while this one still runs."""
    with psycopg.connect(conninfo) as connection:
        tables = connection.execute(
            "SELECT tablename FROM pg_tables WHERE schemaname = 'public' "
            "AND tablename NOT LIKE 'procrastinate%'"
        ).fetchall()
        assert len(tables) > 15
        for (table,) in tables:
            query = sql.SQL("ALTER TABLE {} ADD COLUMN of_a_later_version text NOT NULL DEFAULT 'x'")
            connection.execute(query.format(sql.Identifier(table)))


@pytest.fixture(params=[False, True], ids=["own-tables", "later-tables"])
def conninfo_of_both_versions(conninfo_of_own_version: str, request: pytest.FixtureRequest) -> str:
    """A database of the test's own; also with the further columns that the next version's tables have."""
    if request.param:
        add_columns(conninfo_of_own_version)
    return conninfo_of_own_version


os.environ.pop("DATABASE_URL", None)
