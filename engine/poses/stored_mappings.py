"""States of the mappings of a search, from which a search that was stopped goes on.

Every mapping has a folder of its own, named by its number in the search. Its ``state.json`` is written last
and names the folders of the models that count. One file holds all of them for another host.
"""

import hashlib
import json
import shutil
import sqlite3
import tarfile
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.writing import write_json
from octasplat.engine.poses.stored_search import STORED_MAPPINGS
from octasplat.engine.poses.whole_files import write_model

MAPPINGS_FOLDER = "mappings"
"""In the folder for the work of the search."""
_STATE_FILE = "state.json"


@dataclass(frozen=True)
class MappingState:
    """How far a mapping is.

    Attributes:
        finished: folders of the models that are complete.
        current: folder of the model that grows; None before the first segment of one ends.
        is_done: whether all models are complete.
    """

    finished: tuple[Path, ...] = ()
    current: Path | None = None
    is_done: bool = False


class StoredMapping:
    """Writes the models of one mapping and its state.

    Args:
        folder: of the mapping. A state of other matches that lies there is not taken.
        matches: digest of those that are mapped, see :func:`matches_digest`.
        on_stored: called after each written state, with the number of photographs of the model that grew.

    Attributes:
        state: the newest.
    """

    def __init__(self, folder: Path, matches: str, on_stored: Callable[[int], None]) -> None:
        self._folder = folder
        self._matches = matches
        self._on_stored = on_stored
        self.state = _read_state(folder, matches)

    def write(self, finished: Sequence[Any], current: Any | None, *, is_done: bool) -> None:
        """Write a state, and remove the former model that grew.

        Args:
            finished: ``pycolmap.Reconstruction`` each, complete since the last state.
            current: the model that grows; None if there is none.
            is_done: whether all models are complete.
        """
        before = self.state
        folders = [*before.finished, *(self._write_model(model) for model in finished)]
        self.state = MappingState(
            tuple(folders), None if current is None else self._write_model(current), is_done
        )
        names = {
            "matches": self._matches,
            "finished": [path.name for path in self.state.finished],
            "current": None if self.state.current is None else self.state.current.name,
            "is_done": is_done,
        }
        write_json(self._folder / _STATE_FILE, names)
        if before.current is not None:
            shutil.rmtree(before.current, ignore_errors=True)
        grown = [*finished] if current is None else [current]
        self._on_stored(max((model.num_reg_images() for model in grown), default=0))

    def models(self) -> list[Any]:
        """Return the complete models, as they were written."""
        return [pycolmap.Reconstruction(folder) for folder in self.state.finished]

    def _write_model(self, model: Any) -> Path:
        taken = {int(path.name) for path in self._folder.glob("[0-9]*")} if self._folder.is_dir() else set()
        folder = self._folder / str(max(taken, default=-1) + 1)
        write_model(model, folder)
        return folder


def matches_digest(database: Path) -> str:
    """Return what tells the features and matches of a database from others: how many there are of each."""
    digest = hashlib.sha256()
    with closing(sqlite3.connect(database)) as source:
        for query in (
            "SELECT image_id, rows FROM keypoints ORDER BY image_id",
            "SELECT pair_id, rows FROM two_view_geometries ORDER BY pair_id",
        ):
            digest.update(repr(source.execute(query).fetchall()).encode())
    return digest.hexdigest()


def store_mappings(work: Path) -> Path:
    """Write the states of all mappings of a search into one file, and return it."""
    stored = work / STORED_MAPPINGS
    new = stored.with_suffix(".new")
    try:
        with tarfile.open(new, "w") as archive:
            archive.add(work / MAPPINGS_FOLDER, MAPPINGS_FOLDER)
    except OSError:
        new.unlink(missing_ok=True)  # the search itself needs what room there is
        raise
    return new.replace(stored)


def adopt_stored_mappings(work: Path) -> None:
    """Unpack the stored states of a search, unless its own are there."""
    stored, folder = work / STORED_MAPPINGS, work / MAPPINGS_FOLDER
    if folder.exists() or not stored.exists():
        return
    trial = work / f"{MAPPINGS_FOLDER}.new"
    shutil.rmtree(trial, ignore_errors=True)
    with suppress(OSError, tarfile.TarError):  # without them, mapping begins anew
        with tarfile.open(stored) as archive:
            archive.extractall(trial, filter="data")
        (trial / MAPPINGS_FOLDER).rename(folder)
    shutil.rmtree(trial, ignore_errors=True)


def _read_state(folder: Path, matches: str) -> MappingState:
    """Return the state of a mapping of these matches, and remove the models that it does not name."""
    state = MappingState()
    with suppress(OSError, ValueError, KeyError, TypeError):
        names = json.loads((folder / _STATE_FILE).read_text(encoding="utf-8"))
        if names["matches"] == matches:
            finished, current = tuple(folder / name for name in names["finished"]), names["current"]
            state = MappingState(
                finished, None if current is None else folder / current, bool(names["is_done"])
            )
    for path in folder.glob("[0-9]*"):
        if path not in (*state.finished, state.current):
            shutil.rmtree(path, ignore_errors=True)
    return state
