"""Guard of written files: inputs and files that octasplat did not write are not replaced.

This is the one guard of all verbs. A new file is always written. A file that is there is replaced if
octasplat wrote it on this machine as the same kind of output (a scene, pictures, a surface, ...) and nobody
changed it since, or if the user says ``--overwrite``. A file that the verb reads is never written, nor one in
the folders of photographs or runs that it reads.

Which files octasplat wrote stands in a small database of the user (``written.sqlite``): place, kind, size and
time of each. It is a memory only: without it, ``--overwrite`` is asked for once more.
"""

import os
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import platformdirs

from octasplat.engine.core.errors import ConfigError, OutputError
from octasplat.engine.core.portable_names import is_text
from octasplat.engine.core.scene_layout import SCENE_FOLDERS
from octasplat.engine.core.writing import remove_abandoned
from octasplat.engine.dataset.results_among import is_run_folder

RECORD_VARIABLE = "OCTASPLAT_WRITTEN"
"""Names another file for the database."""
_TABLE = (
    "CREATE TABLE IF NOT EXISTS written "
    "(path TEXT PRIMARY KEY, kind TEXT NOT NULL, size INTEGER NOT NULL, time_ns INTEGER NOT NULL)"
)
_SCENES = (
    "clean", "crop", "deform", "edit", "export", "import", "material", "merge", "simplify", "transform",
)  # fmt: skip
_KINDS = {**dict.fromkeys(_SCENES, "scene"), "render": "pictures", "relight": "pictures"}
"""Verbs that write the same kind of output; that of each other verb is its own."""
_FOR_EDITS = "stage-init"
"""The verb whose output is there to be written on by hand; it is not replaced even if nobody has yet."""
_UNCHANGED_SINCE = dict[str | bytes, tuple[int, int]]
_DATASET_FOLDERS = ("input", *SCENE_FOLDERS)
_RUN_FILES = (
    "config.json", "events.jsonl", "held_out.json", "views.json", "training.json", "plan.json", "scene.ply",
    "edits.json", "environment.hdr", "environment.exr", "background.exr", "residual.npz", "georeference.json",
)  # fmt: skip
_RUN_FOLDERS = ("cache", "checkpoints", "poses")


def check_targets(
    verb: str, targets: Iterable[Path], inputs: Sequence[Path | None], *, overwrite: bool = False
) -> None:
    """Check before long work that files may be written; what killed processes have left of them is removed.

    Args:
        verb: what writes them.
        targets: the files.
        inputs: files and folders that are read; None stands for none.
        overwrite: whether files may be replaced that are not such output of octasplat.

    Raises:
        ConfigError: one of them is read.
        OutputError: one of them is there and somebody else's, or in the place of its folder is a file.
    """
    checked = tuple(dict.fromkeys(targets))  # each once, in order
    read = _Read([path for path in inputs if path is not None])
    for target in checked:
        if target.is_dir():
            raise OutputError(f"{target} is a folder; name a file.")
        above = next((folder for folder in target.parents if folder.exists()), None)
        if above is not None and not above.is_dir():
            raise OutputError(f"{target} cannot be written, as {above} is a file; choose another place.")
        if (folder := read.place_of(target)) is not None:
            raise ConfigError(
                f"{target}: would overwrite what the command reads{folder}; choose another name."
            )
    there = [target for target in checked if target.exists()]
    if there and not overwrite:
        _refuse_foreign(verb, there)
    remove_abandoned(checked)


def _refuse_foreign(verb: str, there: Sequence[Path]) -> None:
    """Raise OutputError if one of the files that are there is somebody else's."""
    known = _recorded_files(verb, there)
    if foreign := [target for target in there if not _is_ours(target, known)]:
        more = f" and {len(foreign) - 1:,} more are" if len(foreign) > 1 else " is"
        raise OutputError(
            f"{foreign[0]}{more} there already and not known as output of octasplat {verb}, or changed "
            "since; choose another name, or say --overwrite."
        )


def remember_written(verb: str, files: Iterable[Path]) -> None:
    """Record files that a verb has written, which it may replace later."""
    rows = []
    for file in files if verb != _FOR_EDITS else ():
        with suppress(OSError):  # a file that is gone is not remembered
            stat = file.stat()
            rows.append((_database_key(file), _kind_of_verb(verb), stat.st_size, stat.st_mtime_ns))
    # The record is a convenience: where it cannot be kept, --overwrite is needed once more.
    with suppress(OSError, sqlite3.Error), _open_database() as database, database:
        database.executemany("INSERT OR REPLACE INTO written VALUES (?, ?, ?, ?)", rows)


class _Read:
    """Files and folders that are read."""

    def __init__(self, inputs: Sequence[Path]) -> None:
        self._files: dict[Path, str] = {}
        self._folders: list[Path] = []
        for path in inputs:
            place = path.resolve()
            if not place.is_dir():
                self._files[place] = ""
                continue
            if (place / "config.json").is_file():
                self._add_run(place)
            else:
                self._add_dataset(place, whole=True)

    def place_of(self, target: Path) -> str | None:
        """Return None for a file that is not read, else words for the input folder it belongs to, if any."""
        place = target.resolve()
        if place in self._files:
            return self._files[place]
        for folder in self._folders:
            # a run inside of a folder that is read is no part of that input
            parents = place.parents[: len(place.parts) - len(folder.parts)]
            if place.is_relative_to(folder) and not any(map(is_run_folder, parents[:-1])):
                return f" in {folder}"
        return None

    def _add_run(self, run: Path) -> None:
        self._files |= {(run / name).resolve(): f" in {run}" for name in _RUN_FILES}
        self._folders += [(run / name).resolve() for name in _RUN_FOLDERS]
        with suppress(ConfigError):  # it holds another config.json
            from octasplat.engine.runs.run_folder import dataset_folder_of_run  # numba and scipy come with it

            photographs = dataset_folder_of_run(run)
            if photographs.is_absolute() and photographs.is_dir():
                self._add_dataset(photographs.resolve(), whole=False)

    def _add_dataset(self, root: Path, *, whole: bool) -> None:
        """Add the folders of a dataset; of photographs alone, or of a scene in a folder, all of it."""
        inner = [(root / name).resolve() for name in _DATASET_FOLDERS if (root / name).is_dir()]
        self._folders += inner or ([root] if whole else [])


def _kind_of_verb(verb: str) -> str:
    return _KINDS.get(verb, verb)


def _database_key(file: Path) -> str | bytes:
    """Return the place of a file as text, or as bytes where its name is no text, which SQLite refuses."""
    place = str(file.resolve())
    return place if is_text(place) else os.fsencode(place)


def _is_ours(file: Path, known: _UNCHANGED_SINCE) -> bool:
    stat = file.stat()
    # size and time are enough: nobody changes a file and keeps both by accident
    return known.get(_database_key(file)) == (stat.st_size, stat.st_mtime_ns)


def _recorded_files(verb: str, files: Sequence[Path]) -> _UNCHANGED_SINCE:
    """Return recorded size and time of the files that are output of the verb's kind."""
    found: _UNCHANGED_SINCE = {}
    with suppress(OSError, sqlite3.Error), _open_database() as database:
        for file in files:
            query = "SELECT size, time_ns FROM written WHERE path = ? AND kind = ?"
            for size, time_ns in database.execute(query, (_database_key(file), _kind_of_verb(verb))):
                found[_database_key(file)] = (size, time_ns)
    return found


@contextmanager
def _open_database() -> Iterator[sqlite3.Connection]:
    named = os.environ.get(RECORD_VARIABLE)
    path = Path(named) if named else platformdirs.user_state_path("octasplat") / "written.sqlite"
    path.parent.mkdir(parents=True, exist_ok=True)
    # other processes may hold the lock for a moment
    with closing(sqlite3.connect(path, timeout=10)) as database:
        database.execute(_TABLE)
        yield database
