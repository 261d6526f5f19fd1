"""Finished frames of a render that the storage holds and the attempt's folder does not hold any more.

A checkpoint of a render is its finished frames. Once it is recorded they are removed from the folder, so that
each of them lies on the disk once; a later attempt does not fetch them. The program learns from
:data:`~octasplat.engine.render.resume.MOVED_FILE` which there are, and names them where they are results.
"""

import contextlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import ValidationError

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.render.resume import MOVED_FILE, RECORD_FILE
from octasplat.workers.db.rows import Job
from octasplat.workers.storage.errors import StorageError
from octasplat.workers.storage.os_errors import translate_os_errors
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.trees import TreeFile
from octasplat.workers.storage.untrusted_folder import UntrustedFolder
from octasplat.workers.storage.verified_copy import check_content
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.job_kinds.stored_options import resolve_here
from octasplat.workers.worker.task import FRAMES_FOLDER, MOVED_RESULTS_FILE, RUN_FOLDER

_FRAMES = f"{RUN_FOLDER}/{FRAMES_FOLDER}/"
_RECORDS = (_FRAMES + RECORD_FILE, _FRAMES + MOVED_FILE)
_MAX_LIST_BYTES = 64 << 20


class StoredFrames:
    """The frames of one attempt that are stored.

    Args:
        folder: of the attempt.
        are_removed: whether stored frames are removed from the folder.
    """

    def __init__(self, folder: Path, *, are_removed: bool) -> None:
        self._folder = folder
        self._are_removed = are_removed
        self._files: dict[str, TreeFile] = {}

    def __contains__(self, name: str) -> bool:
        """Return whether a file of the folder is a frame that is stored."""
        return name in self._files

    def __getitem__(self, name: str) -> TreeFile:
        """Return a stored frame by its name in the folder."""
        return self._files[name]

    def checkpoint_names(self) -> list[str]:
        """Return the record of finished frames, and those that it names, by their names in the folder."""
        with UntrustedFolder(self._folder) as folder:
            try:
                with folder.open(_RECORDS[0]) as handle:
                    rows = [json.loads(line) for line in handle.read(_MAX_LIST_BYTES).splitlines()]
                digests = {_FRAMES + str(row["file"]): row["sha256"] for row in rows[1:]}
            except (StorageError, ValueError, KeyError, TypeError, RecursionError):
                # There are none yet, or they are being written.
                return []
            there = {name for name in (_RECORDS[0], *digests) if folder.is_file(name)}
        # A series that was begun anew has other frames of the same names.
        self._files = {name: file for name, file in self._files.items() if digests.get(name) == file.sha256}
        return [name for name in (_RECORDS[0], *digests) if name in self._files or name in there]

    def add(self, files: Iterable[TreeFile]) -> None:
        """Add the frames among files that were stored; finished ones never change."""
        self._files |= {file.path: file for file in files if _is_frame(file.path)}

    def remove_files(self) -> None:
        """Remove the stored frames from the folder, whose checkpoint is recorded."""
        if self._are_removed and self._files:
            with UntrustedFolder(self._folder) as folder:
                for name in self._files:
                    folder.remove(name)

    def adopt(self, files: Iterable[TreeFile], storage: Storage) -> list[TreeFile]:
        """Take over the frames of a checkpoint, and return its files that are to be fetched.

        Raises:
            StorageError: a frame is gone or damaged, or the folder cannot be written.
        """
        files = list(files)
        fetched = self.fetched(files)
        # No frame stays in the store: all files are fetched.
        if len(fetched) == len(files):
            return files
        self.add(files)
        # They are not fetched, so that damage would show only after the job is done.
        for file in self._files.values():
            check_content(storage.read(file.sha256), file.sha256)
        moved = {name.removeprefix(_FRAMES): file.sha256 for name, file in self._files.items()}
        folder = self._folder / RUN_FOLDER / FRAMES_FOLDER
        with translate_os_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            (folder / MOVED_FILE).write_text(json.dumps(moved), encoding="utf-8")
        return fetched

    def fetched(self, files: Iterable[TreeFile]) -> list[TreeFile]:
        """Return those of a checkpoint's files that another attempt fetches."""
        return [file for file in files if not (self._are_removed and _is_frame(file.path))]

    def results(self) -> list[TreeFile]:
        """Return the results that are stored frames, as the program names them.

        Raises:
            StorageError: the program names others.
        """
        found = []
        for result, name in _read_moved_results(self._folder).items():
            file = self._files.get(str(name))
            if file is None:
                raise StorageError(f"The result {result} is neither in the job's folder nor stored.")
            found.append(file.model_copy(update={"path": str(result)}))
        return found


def _is_frame(name: str) -> bool:
    return name.startswith(_FRAMES) and name not in _RECORDS


def write_moved_results(folder: Path, names: Mapping[str, str]) -> None:
    """Write which results are stored frames: in an attempt's folder, by the name of the result."""
    (folder / MOVED_RESULTS_FILE).write_text(json.dumps(dict(names)), encoding="utf-8")


def removes_stored_frames(job: Job) -> bool:
    """Return whether finished frames of a job leave its folder; not where its kind is unknown here."""
    with contextlib.suppress(ConfigError, ValidationError):
        kind = get_job_kind(job.kind)
        return kind.removes_stored_frames(resolve_here(kind, job))
    return False


def _read_moved_results(folder: Path) -> Mapping[str, str]:
    """Return what a program, which is not trusted, says; nothing if it says nothing."""
    try:
        with UntrustedFolder(folder) as source, source.open(MOVED_RESULTS_FILE) as handle:
            names = json.loads(handle.read(_MAX_LIST_BYTES))
    except (StorageError, ValueError, RecursionError):
        return {}
    return names if isinstance(names, dict) else {}
