"""Copies of a whole service, tables and store, made while it runs and put back elsewhere.

    backup.json          what is there, written last
    tables-*/<name>.copy rows of a table, all of one moment
    store/               a store in a folder with everything that these rows name

A second backup into the same folder copies only contents that it lacks. Queues are not in it: jobs that were
queued or under way when it was made are queued again where it is restored, and go on from their checkpoints.
"""

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psycopg

from octasplat.engine import __version__
from octasplat.engine.core.errors import OctasplatError
from octasplat.engine.core.writing import write_json
from octasplat.workers.db.migrate import OWN_COMPONENT, all_migrations, migrate
from octasplat.workers.maintenance.backup_tables import (
    TABLES_PREFIX,
    copy_tables,
    name_content,
    read_table,
    referenced_contents,
)
from octasplat.workers.storage.errors import BlobNotFoundError, DigestMismatchError
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.os_errors import translate_os_errors
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.trees import read_manifest

FORMAT = 1
BACKUP_FILE, STORE_FOLDER = "backup.json", "store"


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
        snapshot = copy_tables(conninfo, folder)
        copy = LocalStorage(folder / STORE_FOLDER, floor_bytes=0)
        copied = _copy_store(storage, copy, snapshot.referenced, snapshot.jobs, on_content)
        # On a connection that holds no lock while it waits for a table.
        with psycopg.connect(conninfo, autocommit=True) as naming:
            damaged = tuple(name_content(naming, sha256, fault) for sha256, fault in copied.faults.items())
    record = {
        "format": FORMAT, "version": __version__, "folder": snapshot.folder.name, "steps": snapshot.steps,
        "tables": snapshot.tables, "sequences": snapshot.sequences, "lacks": sorted(copied.faults),
    }  # fmt: skip
    # Last, as until then the folder still is the earlier backup.
    with translate_os_errors(folder):
        write_json(folder / BACKUP_FILE, record)
        for earlier in folder.glob(f"{TABLES_PREFIX}*"):
            if earlier != snapshot.folder:
                shutil.rmtree(earlier, ignore_errors=True)
    rows_copied = sum(table["rows"] for table in snapshot.tables)
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
        damaged = tuple(name_content(connection, sha256, fault) for sha256, fault in copied.faults.items())
        for table in record["tables"]:
            read_table(connection, table, folder / record["folder"])
        for name, value in record["sequences"].items():
            if connection.execute("SELECT to_regclass(%s)", [name]).fetchone() != (None,):
                connection.execute("SELECT setval(%s::regclass, %s)", [name, value])
        # Nobody works on them here.
        connection.execute("UPDATE jobs SET state = 'queued', worker = NULL WHERE state = 'running'")
        connection.execute(
            "UPDATE jobs SET state = 'canceled', finished_at = now(), slip = NULL, seconds_left = NULL "
            "WHERE state = 'canceling'"
        )
        missing = referenced_contents(connection) - listed
        missing -= set(record.get("lacks", ()))  # of which was told when it was made
        if missing:
            raise BackupError(
                f"The backup lacks {len(missing)} contents that its tables name; use another one."
            )
    migrate(conninfo)
    rows_copied = sum(table["rows"] for table in record["tables"])
    return BackupSummary(rows_copied, copied.contents, copied.size_bytes, damaged)


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
