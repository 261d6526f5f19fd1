"""What another host needs to go on with a search for poses: files that do not change while they are stored.

A search writes into its database all the time. Now and then it keeps the state of it in a file of its own,
which whoever runs the search may store elsewhere, and tells so. A folder with these files goes on from them.
"""

import json
import os
import sqlite3
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from octasplat.engine.core import versions
from octasplat.engine.core.events import CheckpointWritten, EventListener, Warned
from octasplat.engine.core.writing import write_json
from octasplat.engine.poses.config import PosesConfig
from octasplat.engine.poses.pairs import Pair

DATABASE = "database.db"
"""Of the first search, in the folder for the work."""
STORED_DATABASE, SEARCH_FILE, PAIRS_FILE = "stored.db", "search.json", "pairs.json"
STORED_MAPPINGS = "mappings.tar"
VOCABULARY_FILE, VOCABULARY_RECORD = "vocabulary.bin", "vocabulary.json"
STORED_SEARCH_FILES = (
    SEARCH_FILE, PAIRS_FILE, STORED_DATABASE, STORED_MAPPINGS, VOCABULARY_FILE, VOCABULARY_RECORD
)  # fmt: skip
"""What is to be stored; the database says how far the search is, and pairs are there after the quick look.
Of a large capture there are also mappings, see :mod:`octasplat.engine.poses.stored_mappings`,
and the vocabulary, see :mod:`octasplat.engine.poses.vocabulary`."""
STORED_FROM = 100
"""Photographs from which on the state is kept: the search for fewer is soon done again."""
_STORE_SECONDS = 600.0
"""From one state to the next within a stage."""


def search_folder(output: Path) -> Path:
    """Return the hidden folder beside ``output`` in which poses are searched that are written there."""
    return output.with_name(f".{output.name}.work")


def search_record(photographs_sha256: str, config: PosesConfig) -> dict[str, Any]:
    """Return what tells a search from any other, for :data:`SEARCH_FILE`."""
    return {
        "photographs_sha256": photographs_sha256,
        "config": config.model_dump(mode="json"),
        "results": versions.RESULTS_VERSION,
    }


def is_stopped_search(work: Path, search: Mapping[str, Any], progress: EventListener) -> bool:
    """Return whether the same search has left a folder; tell if it was one of another version.

    Args:
        work: the folder.
        search: as :func:`search_record` has it.
        progress: told that a search begins anew whose features and matches may be others by now.
    """
    try:
        left = json.loads((work / SEARCH_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    if left == search:
        return True
    of_version = left.get("results") if isinstance(left, dict) else search["results"]
    if of_version != search["results"]:  # former versions did not say theirs
        progress(
            Warned(
                "The search for poses was begun by another version of octasplat, which may have found other "
                "features and matches, so it begins anew."
            )
        )
    return False


def adopt_stored_database(work: Path) -> None:
    """Let a search in ``work`` go on from what was stored, unless it has a database there."""
    stored = work / STORED_DATABASE
    if (work / DATABASE).exists():
        stored.unlink(missing_ok=True)  # it may be the same file, which is written again
    elif stored.exists():
        stored.rename(work / DATABASE)


def store_database(work: Path) -> None:
    """Keep the database of a search that maps, if an attempt that goes on has not done so."""
    if not (work / STORED_DATABASE).exists():
        _link(work / DATABASE)


def store_stopped_search(work: Path) -> Path | None:
    """Keep the state of a search that was stopped, and return it; None where there is nothing yet."""
    database = work / DATABASE
    if not database.exists():
        return None
    try:
        return _link(database)
    except (OSError, sqlite3.Error):
        return None  # a convenience: the search is begun again


def read_pairs(database: Path) -> list[Pair] | None:
    """Return the pairs that a quick look at a database found alike; None where there was none yet."""
    try:
        return [(int(a), int(b)) for a, b in json.loads(_pairs_file(database).read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError):
        return None


def write_pairs(database: Path, pairs: Sequence[Pair]) -> None:
    """Write the pairs that a quick look at a database found alike."""
    write_json(_pairs_file(database), [list(pair) for pair in pairs])


def _pairs_file(database: Path) -> Path:
    if database.name == DATABASE:
        return database.with_name(PAIRS_FILE)
    return database.with_name(f"{database.stem}.{PAIRS_FILE}")


class SearchKeeper:
    """Keeps the state of a search of many photographs, at times and at the end of a stage.

    Args:
        database: of the search; only the first one of its folder is kept.
        photographs: how many there are.
        progress: hears of each state.
    """

    def __init__(self, database: Path, photographs: int, progress: EventListener) -> None:
        self._database = database
        self._is_on = photographs >= STORED_FROM and database.name == DATABASE
        self._progress = progress
        self._kept_at = time.monotonic()
        self._first: int | None = None

    def keep_at_times(self, step: int) -> None:
        """Keep a copy of the database, which nobody has open, if the last one is old."""
        if self._first is None:
            self._first = step  # which an earlier attempt has reached
        if time.monotonic() - self._kept_at >= _STORE_SECONDS:
            self.keep(step)

    def keep(self, step: int, *, is_final: bool = False) -> None:
        """Keep the database, after ``step`` steps of the stage; nothing where it has no new ones.

        Args:
            step: that is done.
            is_final: whether it is not written any more, so that it need not be copied.
        """
        if not self._is_on or step == self._first:
            return
        with suppress(OSError, sqlite3.Error):  # as on a full disk, which the search finds itself
            stored = _link(self._database) if is_final else _copy(self._database)
            self._progress(CheckpointWritten(step, str(stored)))
        self._kept_at = time.monotonic()


def _copy(database: Path) -> Path:
    stored = database.with_name(STORED_DATABASE)
    new = stored.with_suffix(".new")
    new.unlink(missing_ok=True)
    try:
        with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(new)) as target:
            source.backup(target)
    except (OSError, sqlite3.Error):
        new.unlink(missing_ok=True)
        raise
    return new.replace(stored)


def _link(database: Path) -> Path:
    with closing(sqlite3.connect(database)) as source:  # what was written last may be in another file
        source.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    stored = database.with_name(STORED_DATABASE)
    stored.unlink(missing_ok=True)
    os.link(database, stored)
    return stored
