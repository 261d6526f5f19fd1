"""Copies of a whole service, tables and store, made while it runs and put back elsewhere.

    backup.json          what is there, written last
    tables-*/<name>.copy rows of a table, all of one moment
    store/               a store in a folder with everything that these rows name

A second backup into the same folder copies only contents that it lacks. Queues are not in it: jobs that were
queued or under way when it was made are queued again where it is restored, and go on from their checkpoints.
"""

import contextlib
import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, LiteralString

import psycopg
from psycopg import sql

from octasplat.engine import __version__
from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.core.writing import write_json
from octasplat.workers.db.migrate import OWN_COMPONENT, all_migrations, migrate
from octasplat.workers.storage.errors import BlobNotFoundError, DigestMismatchError
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.os_errors import translate_os_errors
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.trees import read_manifest

FORMAT = 1
BACKUP_FILE, TABLES_PREFIX, STORE_FOLDER = "backup.json", "tables-", "store"
# What migrate writes by itself, and what processes write that do not run where it is restored.
_EXCLUDED_TABLES = ("schema_steps", "schema_reach", "workers", "storing", "removing_contents")
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


class BackupError(OctasplatError):
    """A backup cannot be made or put back."""


@dataclass(frozen=True)
class BackupSummary:
    """Content of a backup: row counts, the count and total length of its blobs, and what could not be copied.

    Attributes:
        rows: of all tables.
        contents: that were copied, or were there already.
        size_bytes: their length.
        damaged: contents of the store that are damaged or missing, one sentence each; they are not in it.
    """

    rows: int
    contents: int
    size_bytes: int
    damaged: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Copied:
    """Copied contents: their count and total length, and what is wrong with others by digest."""

    contents: int
    size_bytes: int
    faults: dict[str, str]


def create_backup(
    conninfo: str, storage: Storage, folder: Path, on_content: Callable[[int, int], None] = lambda *_: None
) -> BackupSummary:
    """Copy everything into a folder.

    Args:
        conninfo: of the database.
        storage: the store.
        folder: new, or that of an earlier backup, which stays whole until this one is.
        on_content: told (contents copied, contents to copy).

    Raises:
        BackupError: the folder holds something else.
        StorageError: a store cannot be read or written.
        psycopg.Error: the database cannot be read.
    """
    with translate_os_errors(folder):
        names = {path.name for path in folder.iterdir()} if folder.exists() else set()
        if names and not names & {BACKUP_FILE, STORE_FOLDER}:
            raise BackupError(f"{folder} holds files and no backup; name another folder.")
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    with psycopg.connect(conninfo) as collecting:
        # Whoever collects unused contents leaves it to us, so that all that is named now stays.
        collecting.execute("SELECT id FROM installation FOR UPDATE")
        # The snapshot ends before contents are copied: its locks hold up whoever changes the tables.
        with psycopg.connect(conninfo) as connection:
            connection.isolation_level = psycopg.IsolationLevel.REPEATABLE_READ
            connection.read_only = True
            rows = folder / f"{TABLES_PREFIX}{uuid.uuid4().hex[:12]}"
            with translate_os_errors(folder):
                rows.mkdir(mode=0o700)
            tables = [_write_table(connection, name, rows) for name in _ordered_tables(connection)]
            steps = [name for (name,) in connection.execute(
                "SELECT name FROM schema_steps WHERE component = %s ORDER BY name", [OWN_COMPONENT]
            )]  # fmt: skip
            sequences: dict[str, int] = dict(connection.execute(
                "SELECT sequencename, last_value FROM pg_sequences "
                "WHERE schemaname = current_schema() AND last_value IS NOT NULL"
            ).fetchall())  # fmt: skip
            referenced = _referenced_contents(connection)
            jobs = {str(job_id) for (job_id,) in connection.execute("SELECT id FROM jobs")}
        copy = LocalStorage(folder / STORE_FOLDER, floor_bytes=0)
        copied = _copy_store(storage, copy, referenced, jobs, on_content)
        damaged = tuple(_name_content(collecting, sha256, fault) for sha256, fault in copied.faults.items())
    record = {
        "format": FORMAT, "version": __version__, "folder": rows.name,
        "steps": steps, "tables": tables, "sequences": sequences, "lacks": sorted(copied.faults),
    }  # fmt: skip
    # Last, as until then the folder still is the earlier backup.
    with translate_os_errors(folder):
        write_json(folder / BACKUP_FILE, record)
        for earlier in folder.glob(f"{TABLES_PREFIX}*"):
            if earlier != rows:
                shutil.rmtree(earlier, ignore_errors=True)
    rows_copied = sum(table["rows"] for table in tables)
    return BackupSummary(rows_copied, copied.contents, copied.size_bytes, damaged)


def restore_backup(
    conninfo: str, storage: Storage, folder: Path, on_content: Callable[[int, int], None] = lambda *_: None
) -> BackupSummary:
    """Put a backup into an empty database and an empty store.

    Args:
        conninfo: of the database; its tables are made, and brought up to this version afterwards.
        storage: the store.
        folder: of the backup.
        on_content: as in :func:`create_backup`.

    Raises:
        BackupError: the folder holds no backup that this version can read, or something is not empty.
        DatabaseError: the tables cannot be made.
        StorageError: a store cannot be read or written.
    """
    record = _read_backup_file(folder)
    if next(storage.list_blobs(), None) is not None:
        raise BackupError("The store is not empty; name another one, or another data folder.")
    known = {step.name for step in all_migrations() if step.component == OWN_COMPONENT}
    if not known.issuperset(record["steps"]):
        raise BackupError(f"{folder} was made by a newer version ({record['version']}); install that one.")
    # The steps that the rows were written under; later ones change the rows together with the tables.
    migrate(conninfo, only=record["steps"])
    with psycopg.connect(conninfo) as connection:
        if connection.execute("SELECT EXISTS (TABLE datasets) OR EXISTS (TABLE jobs)").fetchone() != (False,):
            raise BackupError("The database is not empty; name another one, or another data folder.")
        copy = LocalStorage(folder / STORE_FOLDER, floor_bytes=0)
        listed = {entry.blob.sha256 for entry in copy.list_blobs()}
        copied = _copy_store(copy, storage, listed, None, on_content)
        damaged = tuple(_name_content(connection, sha256, fault) for sha256, fault in copied.faults.items())
        for table in record["tables"]:
            _read_table(connection, table, folder / record["folder"])
        for name, value in record["sequences"].items():
            if connection.execute("SELECT to_regclass(%s)", [name]).fetchone() != (None,):
                connection.execute("SELECT setval(%s::regclass, %s)", [name, value])
        # Nobody works on them here.
        connection.execute("UPDATE jobs SET state = 'queued', worker = NULL WHERE state = 'running'")
        connection.execute(
            "UPDATE jobs SET state = 'canceled', finished_at = now(), slip = NULL, seconds_left = NULL "
            "WHERE state = 'canceling'"
        )
        missing = _referenced_contents(connection) - listed
        missing -= set(record.get("lacks", ()))  # of which was told when it was made
        if missing:
            raise BackupError(
                f"The backup lacks {len(missing)} contents that its tables name; use another one."
            )
    migrate(conninfo)
    rows_copied = sum(table["rows"] for table in record["tables"])
    return BackupSummary(rows_copied, copied.contents, copied.size_bytes, damaged)


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


def _read_table(connection: psycopg.Connection, table: dict[str, Any], folder: Path) -> None:
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


def _copy_store(
    source: Storage,
    target: Storage,
    digests: set[str],
    jobs: set[str] | None,
    on_content: Callable[[int, int], None],
) -> _Copied:
    """Copy contents and documents; of the latter only those of ``jobs``, and what these name.

    What is damaged or missing is left out and told.
    """
    documents = list(source.list_documents())
    if jobs is not None:
        results = [name for name in documents if name.startswith("results/") and name.split("/")[1] in jobs]
        documents = [name for name in documents if not name.startswith("results/")] + results
        for name in results:
            manifest = read_manifest(source, name)
            digests = digests | {file.sha256 for file in manifest.files} if manifest is not None else digests
    there = {entry.blob.sha256: entry.blob.size_bytes for entry in target.list_blobs()}
    size_bytes = 0
    faults: dict[str, str] = {}
    for done, sha256 in enumerate(sorted(digests), start=1):
        try:
            if sha256 not in there:
                there[sha256] = _copy_content(source, target, sha256)
            size_bytes += there[sha256]
        except BlobNotFoundError:
            faults[sha256] = "missing"
        except DigestMismatchError:
            faults[sha256] = "damaged"
        on_content(done, len(digests))
    for name in documents:
        document = source.read_document(name)
        if document is not None and not target.publish_document(name, document):
            # An earlier backup holds another document of that name.
            target.remove_document(name)
            target.publish_document(name, document)
    return _Copied(len(digests) - len(faults), size_bytes, faults)


def _copy_content(source: Storage, target: Storage, sha256: str) -> int:
    """Copy a content; returns its length.

    Raises:
        BlobNotFoundError: the store lacks it.
        DigestMismatchError: what is there is another content, or cannot be read.
    """
    blob = source.stat(sha256)
    with target.open_writer(sha256=sha256, size_bytes=blob.size_bytes) as writer:
        pieces = source.read(sha256)
        while True:
            try:
                piece = next(pieces, None)
            except OSError as error:  # a sector of the disk is bad
                raise DigestMismatchError(f"The content {sha256} cannot be read.") from error
            if piece is None:
                break
            writer.write(piece)
        writer.commit()
    return blob.size_bytes


def _referenced_contents(connection: psycopg.Connection) -> set[str]:
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


def _name_content(connection: psycopg.Connection, sha256: str, fault: str) -> str:
    """Return a sentence on a content that is ``damaged`` or ``missing``, with a place that names it."""
    query = sql.SQL("SELECT place FROM ({}) AS named (sha256, place) WHERE sha256 = %s LIMIT 1")
    row = connection.execute(query.format(_references(connection)), [sha256]).fetchone()
    return f"{row[0] if row is not None else 'A content'} is {fault} in the store ({sha256})."


def _read_backup_file(folder: Path) -> dict[str, Any]:
    try:
        record: dict[str, Any] = json.loads((folder / BACKUP_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise BackupError(f"{folder} holds no backup; name the folder that octasplat backup wrote.") from None
    if record.get("format") != FORMAT:
        raise BackupError(
            f"{folder} is a backup of another version ({record.get('version')}); install that one."
        )
    return record


@contextlib.contextmanager
def translate_database_errors() -> Iterator[None]:
    """Translate errors of the database into sentences for users.

    Raises:
        BackupError: what went wrong.
    """
    try:
        yield
    except psycopg.Error as error:
        raise BackupError(f"The database does not do as asked: {' '.join(str(error).split())}") from None
