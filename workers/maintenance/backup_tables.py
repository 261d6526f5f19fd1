"""Tables of a service as files: rows of one moment, written while others change them, and read back."""

import os
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, LiteralString

import psycopg
from psycopg import sql

from octasplat.workers.db.migrate import MAX_WAIT_SECONDS, OWN_COMPONENT
from octasplat.workers.storage.os_errors import translate_os_errors

TABLES_PREFIX = "tables-"
# What migrate writes by itself, and what processes write that do not run where it is restored.
_EXCLUDED_TABLES = ("schema_steps", "schema_reach", "workers", "storing", "removing_contents")
_POLL_SECONDS = 0.2
_REFERENCES: Mapping[str, LiteralString] = {
    "dataset_files": """
        SELECT sha256, 'The file ' || path || ' of the dataset ' || dataset_id FROM dataset_files
        """,
    "upload_parts": "SELECT sha256, 'A part of the upload ' || upload_id FROM upload_parts",
    "artifacts": "SELECT sha256, 'The result ' || name || ' of the job ' || job_id FROM artifacts",
    "jobs": """
        SELECT file->>'sha256', 'The checkpoint of the job ' || id
        FROM jobs, jsonb_array_elements(checkpoint->'files') AS file
        UNION ALL
        SELECT preview->>'sha256', 'The preview of the job ' || id FROM jobs WHERE preview ? 'sha256'
        """,
    "live_scenes": """
        SELECT content, 'The live scene of the job ' || job_id
        FROM live_scenes, unnest(ARRAY[sha256, views_sha256]) AS content
        """,
}
"""By table, what selects the digests of contents that its rows name, and what to call the place."""


@dataclass(frozen=True)
class Snapshot:
    """What the tables held at one moment, and the folder with their rows."""

    folder: Path
    tables: list[dict[str, Any]]
    steps: list[str]
    sequences: dict[str, int]
    referenced: set[str]
    jobs: set[str]


def copy_tables(conninfo: str, folder: Path) -> Snapshot:
    """Write the rows of all tables into a new folder beneath ``folder``.

    The transaction ends before contents are copied, as its locks delay whoever changes the tables.

    Raises:
        StorageError: the folder cannot be written.
        psycopg.Error: the database cannot be read.
    """
    rows = folder / f"{TABLES_PREFIX}{uuid.uuid4().hex[:12]}"
    with translate_os_errors(folder):
        rows.mkdir(mode=0o700)
    with psycopg.connect(conninfo) as connection:
        connection.isolation_level = psycopg.IsolationLevel.REPEATABLE_READ
        connection.read_only = True
        _lock_tables(connection)
        tables = [_write_table(connection, name, rows) for name in _ordered_tables(connection)]
        steps = [name for (name,) in connection.execute(
            "SELECT name FROM schema_steps WHERE component = %s ORDER BY name", [OWN_COMPONENT]
        )]  # fmt: skip
        sequences: dict[str, int] = dict(connection.execute(
            "SELECT sequencename, last_value FROM pg_sequences "
            "WHERE schemaname = current_schema() AND last_value IS NOT NULL"
        ).fetchall())  # fmt: skip
        referenced = referenced_contents(connection)
        jobs = {str(job_id) for (job_id,) in connection.execute("SELECT id FROM jobs")}
    return Snapshot(rows, tables, steps, sequences, referenced, jobs)


def _lock_tables(connection: psycopg.Connection) -> None:
    """Lock all that is read against changes of its columns, before the first row is read.

    A transaction that waits for a table while it holds others can end in a deadlock with a migration. Where
    that happens here, nothing has been read yet, and the locks are requested again.

    Raises:
        psycopg.Error: the tables are being changed for too long.
    """
    deadline = time.monotonic() + MAX_WAIT_SECONDS
    while True:
        names = [*_ordered_tables(connection), "schema_steps"]
        connection.rollback()
        try:
            # The snapshot begins with the first query, so after these locks.
            connection.execute(
                sql.SQL("LOCK TABLE {} IN ACCESS SHARE MODE").format(
                    sql.SQL(", ").join(map(sql.Identifier, names))
                )
            )
            if {*_ordered_tables(connection), "schema_steps"} == set(names):
                return
        except (psycopg.errors.DeadlockDetected, psycopg.errors.UndefinedTable):
            if time.monotonic() > deadline:
                raise
        connection.rollback()
        time.sleep(_POLL_SECONDS)


def _ordered_tables(connection: psycopg.Connection) -> list[str]:
    """Return our tables, each after those that it references."""
    rows = connection.execute(
        "SELECT tablename FROM pg_tables WHERE schemaname = current_schema() "
        "AND tablename NOT LIKE 'procrastinate%' ORDER BY 1"
    )
    left = [name for (name,) in rows if name not in _EXCLUDED_TABLES]
    refers = connection.execute(
        "SELECT conrelid::regclass::text, confrelid::regclass::text FROM pg_constraint WHERE contype = 'f'"
    ).fetchall()
    ordered: list[str] = []
    while left:
        free = [t for t in left if not any(a == t and b in left and b != t for a, b in refers)]
        ordered += free
        left = [t for t in left if t not in free]
    return ordered


def _write_table(connection: psycopg.Connection, name: str, folder: Path) -> dict[str, Any]:
    columns = [column for (column,) in connection.execute(
        "SELECT attname FROM pg_attribute WHERE attrelid = %s::regclass AND attnum > 0 AND NOT attisdropped "
        "ORDER BY attnum", [name]
    )]  # fmt: skip
    rows = 0
    with (
        translate_os_errors(folder),
        (folder / f"{name}.copy").open("wb") as handle,
        connection.cursor() as cursor,
    ):
        with cursor.copy(
            sql.SQL("COPY {} ({}) TO STDOUT").format(*_table_identifiers(name, columns))
        ) as copy:
            for piece in copy:
                # COPY writes one line for each row, and escapes line ends within values.
                rows += bytes(piece).count(b"\n")
                handle.write(piece)
        handle.flush()
        os.fsync(handle.fileno())
    return {"name": name, "columns": columns, "rows": rows}


def read_table(connection: psycopg.Connection, table: dict[str, Any], folder: Path) -> None:
    """Read rows unchanged, with triggers disabled."""
    name, columns = _table_identifiers(table["name"], table["columns"])
    connection.execute(sql.SQL("ALTER TABLE {} DISABLE TRIGGER USER").format(name))
    connection.execute(sql.SQL("DELETE FROM {}").format(name))
    with (
        translate_os_errors(folder),
        (folder / f"{table['name']}.copy").open("rb") as handle,
        connection.cursor() as cursor,
        cursor.copy(sql.SQL("COPY {} ({}) FROM STDIN").format(name, columns)) as copy,
    ):
        while piece := handle.read(1 << 20):
            copy.write(piece)
    connection.execute(sql.SQL("ALTER TABLE {} ENABLE TRIGGER USER").format(name))


def _table_identifiers(name: str, columns: list[str]) -> tuple[sql.Composable, sql.Composable]:
    return sql.Identifier(name), sql.SQL(", ").join(map(sql.Identifier, columns))


def referenced_contents(connection: psycopg.Connection) -> set[str]:
    """Return the SHA-256 digests of all contents that rows name."""
    query = sql.SQL("SELECT DISTINCT sha256 FROM ({}) AS named (sha256, place)")
    return {sha256 for (sha256,) in connection.execute(query.format(_references(connection)))}


def _references(connection: psycopg.Connection) -> sql.Composed:
    """Return the query of :data:`_REFERENCES` for the tables that are there; an earlier version has fewer."""
    there = {name for (name,) in connection.execute(
        "SELECT tablename FROM pg_tables WHERE schemaname = current_schema()"
    )}  # fmt: skip
    return sql.SQL(" UNION ALL ").join(
        sql.SQL(query) for table, query in _REFERENCES.items() if table in there
    )


def name_content(connection: psycopg.Connection, sha256: str, fault: str) -> str:
    """Return a sentence on a content that is ``damaged`` or ``missing``, with a place that names it."""
    query = sql.SQL("SELECT place FROM ({}) AS named (sha256, place) WHERE sha256 = %s LIMIT 1")
    row = connection.execute(query.format(_references(connection)), [sha256]).fetchone()
    return f"{row[0] if row is not None else 'A content'} is {fault} in the store ({sha256})."
