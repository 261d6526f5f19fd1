"""Photographs on this machine: a folder for each dataset, shared by all attempts and filled by their needs.

All files of the dataset are there by name from the beginning; those that nobody here has needed are empty.
"""

import fcntl
import os
import re
import shutil
import uuid
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import IO

from octasplat.engine.core.portable_names import NameSet
from octasplat.workers.db.rows import DatasetFile
from octasplat.workers.storage.os_errors import translate_os_errors
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.worker.workspace_locks import lock_dataset_folder

FILLED_BY_NEED = ".files"
"""Follows the id in the name of the folder: earlier versions, which may run beside this one, take a folder
that is called by the id alone for complete."""


class DatasetFolder:
    """The photographs of a dataset, kept from being swept until :meth:`close`; they must not be changed.

    Args:
        root: folder of all work on this machine.
        dataset_id: of the dataset.
        name: of the dataset, by which its folder is called.

    Raises:
        StorageError: the folder cannot be made.
    """

    def __init__(self, root: Path, dataset_id: uuid.UUID, name: str) -> None:
        self._folder = root / "datasets" / f"{dataset_id}{FILLED_BY_NEED}"
        with translate_os_errors(self._folder):
            self._lock: IO[bytes] = lock_dataset_folder(self._folder)
        self.place = self._folder / (re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_")[:60] or "scene")

    def close(self) -> None:
        """Let the folder be swept once nobody has used it for a while."""
        self._lock.close()

    def fill(
        self, storage: Storage, files: Sequence[DatasetFile], needed: Collection[str] | None = None
    ) -> None:
        """Fetch files that are not here yet, each of them once for all attempts on this machine.

        Args:
            storage: where from.
            files: all files of the dataset.
            needed: paths of those to fetch; None fetches all.

        Raises:
            StorageError: a file is gone or damaged, or the folder cannot be written.
            FileNameError: a name would lead elsewhere.
        """
        with translate_os_errors(self._folder):
            if not self.place.exists():
                self._make(files)
            for file in files:
                if needed is None or file.path in needed:
                    self._fetch(storage, file)
            os.utime(self._folder)  # the sweep goes by this time

    def _make(self, files: Sequence[DatasetFile]) -> None:
        known = NameSet()
        for file in files:
            known.add(file.path)
        # Other attempts look for the final name, which only a folder with all names gets.
        partial = self._temporary()
        try:
            partial.mkdir()
            for file in files:
                path = partial / file.path
                path.parent.mkdir(parents=True, exist_ok=True)
                path.touch()
            try:
                partial.rename(self.place)
            except OSError:
                if not self.place.exists():  # else another attempt was faster
                    raise
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def _fetch(self, storage: Storage, file: DatasetFile) -> None:
        path = self.place / file.path
        # What is here is complete, as its size tells: it replaced the empty file in one step.
        if path.stat().st_size == file.size_bytes:
            return
        with path.open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if path.stat().st_size == file.size_bytes:  # another attempt was faster
                return
            partial = self._temporary()
            try:
                storage.materialise(file.sha256, partial)
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)

    def _temporary(self) -> Path:
        return self._folder / f".{uuid.uuid4().hex}.partial"
