"""Folder of an attempt: filled from the storage before the work, stored afterwards. All calls block."""

import contextlib
import json
import logging
import math
import time
import uuid
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import IO

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.db.rows import Artifact, DatasetFile, Job
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.sandbox.job_users import JobUser, give_folder, open_for_reading, take_user
from octasplat.workers.storage.errors import (
    BlobNotFoundError,
    DigestMismatchError,
    StorageError,
    UntrustedFileError,
)
from octasplat.workers.storage.folder_removal import remove_folder
from octasplat.workers.storage.os_errors import translate_os_errors
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.trees import (
    Manifest,
    TreeFile,
    fetch_tree,
    merge_files,
    publish_manifest,
    read_manifest,
    store_tree,
)
from octasplat.workers.storage.untrusted_folder import UntrustedFolder
from octasplat.workers.worker.checkpoint import Checkpoint
from octasplat.workers.worker.checkpoint_files import checkpoint_files, poses_state
from octasplat.workers.worker.dataset_folder import DatasetFolder
from octasplat.workers.worker.media_types import media_type
from octasplat.workers.worker.start_files import START_RECORD
from octasplat.workers.worker.stored_frames import StoredFrames, removes_stored_frames
from octasplat.workers.worker.task import (
    FILES_FOLDER,
    POSES_FOLDER,
    RESULTS_FOLDER,
    RUN_FOLDER,
)
from octasplat.workers.worker.workspace_locks import LOCK_FILE, open_locked

logger = logging.getLogger(__name__)

_MAX_TRIES = 5
METRICS_FILE = "metrics.json"
MAX_METRICS_BYTES = 16 << 20


class Workspace:
    """The folder of one attempt; nobody else uses it, and it is removed at the end.

    Args:
        root: folder of all work on this machine.
        job: the job, claimed.
        storage: the store.
    """

    def __init__(self, root: Path, job: Job, storage: Storage) -> None:
        self._root = root
        self._job = job
        self.storage = storage
        self.folder = root / "attempts" / f"{job.id}.{job.attempt}"
        self._lock: IO[bytes] | None = None
        self._user: JobUser | None = None
        self._dataset: DatasetFolder | None = None
        self.stored_frames = StoredFrames(self.folder, are_removed=removes_stored_frames(job))
        self._own_block = f"block_{job.options['number']:03d}" if job.role == "block" else None
        self._peak_used_bytes = 0

    def open(self) -> None:
        """Create the folder, replacing one of that name.

        Raises:
            StorageError: it cannot be made.
        """
        with translate_os_errors(self._root):
            remove_folder(self.folder)
            self.folder.mkdir(parents=True, mode=0o700)
            self._lock = open_locked(self.folder / LOCK_FILE)

    def give_to_user(self, uids: range) -> int:
        """Choose the user that the job runs as and give it the folder; return its id.

        Raises:
            ConfigError: all are taken.
            StorageError: the folder cannot be given away.
        """
        with translate_os_errors(self.folder):
            self._user = take_user(uids, self._root)
            give_folder(self.folder, self._user.uid)
            if self._dataset is not None:
                open_for_reading(self._dataset.place.parent)
        return self._user.uid

    def close(self) -> None:
        """Remove the folder and release its locks."""
        # Before the user is released, as the next job of that user could read what is left.
        remove_folder(self.folder)
        if self._user is not None:
            self._user.close()
            self._user = None
        if self._lock is not None:
            self._lock.close()
            self._lock = None
        if self._dataset is not None:
            self._dataset.close()
            self._dataset = None

    def used_bytes(self) -> int:
        """Return the disk usage of the folder, without files shared with the storage.

        Raises:
            UntrustedFileError: the program keeps it from being measured.
        """
        try:
            with UntrustedFolder(self.folder) as folder:
                taken = folder.disk_usage_bytes(leave_out=FILES_FOLDER)
        except UntrustedFileError:
            raise
        except StorageError:  # it is gone
            taken = 0
        self._peak_used_bytes = max(taken, self._peak_used_bytes)
        return taken

    def peak_used_bytes(self) -> int:
        """Return the largest disk usage that was measured."""
        with contextlib.suppress(UntrustedFileError):
            self.used_bytes()
        return self._peak_used_bytes

    def fetch_dataset(
        self,
        dataset_id: uuid.UUID,
        files: Sequence[DatasetFile],
        name: str,
        needed: Collection[str] | None = None,
    ) -> Path:
        """Fetch photographs into a folder shared by all attempts here; its files must not be changed.

        Args:
            dataset_id: of the dataset.
            files: all of its files; those that are not fetched may be empty.
            name: of the dataset.
            needed: paths of the files to fetch; None fetches all.

        Raises:
            StorageError: a photograph is gone or damaged, or the folder cannot be written.
        """
        self._dataset = DatasetFolder(self._root, dataset_id, name)
        self._dataset.fill(self.storage, files, needed)
        return self._dataset.place

    def fetch_files(self, files: Sequence[DatasetFile]) -> None:
        """Fetch the files that the options name; they must not be changed."""
        fetch_tree(self.storage, _tree_files(files), self.folder / FILES_FOLDER)

    def fetch_source(self, artifacts: Sequence[Artifact], names: Sequence[str]) -> None:
        """Fetch results of the source job into the run folder."""
        tree = [
            TreeFile(path=a.name, sha256=a.sha256, size_bytes=a.size_bytes)
            for a in artifacts
            if a.name in names
        ]
        poses = [
            TreeFile(path=a.name, sha256=a.sha256, size_bytes=a.size_bytes)
            for a in artifacts
            if a.name.startswith(f"{POSES_FOLDER}/")
        ]
        fetch_tree(self.storage, [*tree, *poses], self.folder / RUN_FOLDER, writable=True)

    def has_start(self) -> bool:
        """Return whether the run has its copy of what it begins with."""
        return (self.folder / START_RECORD).exists()

    def fetch_start(self, source_id: uuid.UUID | None, choices: Sequence[Sequence[TreeFile]]) -> Path:
        """Fetch what a run begins with into a folder that is called as the job which it is of.

        Args:
            source_id: that job; None if it was deleted.
            choices: see :func:`octasplat.workers.worker.start_files.start_choices`; the first that is there.

        Raises:
            ConfigError: there is none.
            StorageError: all are gone or damaged, or the folder cannot be written.
        """
        if source_id is None:
            raise ConfigError("The job that this one begins with was deleted; make a new job.")
        place = self.folder / f"job {source_id}"
        lost: StorageError | None = None
        for files in choices:
            try:
                fetch_tree(self.storage, files, place, writable=True)
            except (BlobNotFoundError, DigestMismatchError) as error:
                logger.warning("a start of job %s is lost: %s", self._job.id, error)
                lost = error
                remove_folder(place)
                continue
            return place
        if lost is not None:
            raise BlobNotFoundError(f"What {place.name} has made is gone from the store; begin with another.")
        raise ConfigError(
            f"{place.name} has neither a scene nor a checkpoint any more; begin with another job."
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        """Restore the checkpoint of an earlier attempt.

        Raises:
            StorageError: some of it is gone or damaged.
        """
        files = self.stored_frames.adopt(checkpoint.files, self.storage)
        fetch_tree(self.storage, files, self.folder, writable=True)

    def fetch_from_others(self, files: Sequence[TreeFile]) -> set[str]:
        """Fetch what other jobs have made for this one, by its place in the folder.

        Returns:
            Digests of what is gone or damaged; of the blocks that made it nothing is there.

        Raises:
            BlobNotFoundError: it is what a block begins with.
        """
        lost: list[TreeFile] = []
        for file in files:
            try:
                fetch_tree(self.storage, [file], self.folder, writable=True)
            except (BlobNotFoundError, DigestMismatchError) as error:
                logger.warning("%s is lost: %s", file.path, error)
                lost.append(file)
        if lost and self._own_block is not None:
            raise BlobNotFoundError(
                f"What the blocks begin with is gone from the store ({lost[0].path}); retry the job from the "
                "start."
            )
        for file in lost:
            remove_folder((self.folder / file.path).parent)
        return {file.sha256 for file in lost}

    def discard_run(self) -> None:
        """Discard what was restored."""
        remove_folder(self.folder / RUN_FOLDER)
        self.stored_frames = StoredFrames(self.folder, are_removed=removes_stored_frames(self._job))

    def store_checkpoint(self, stage: str, step: int) -> Checkpoint | None:
        """Store what a later attempt needs to resume; None if there is nothing yet.

        Poses are those of one model folder, whole: one that is exchanged meanwhile is stored again.
        """
        for attempt in range(_MAX_TRIES):
            if attempt:
                time.sleep(0.05)
            with UntrustedFolder(self.folder) as folder:
                poses = poses_state(folder)
                names = self._checkpoint_files(folder, stage)
            if poses is None:
                continue
            if not names:
                return None
            try:
                files = self._store_files(names)
            except StorageError:
                # The program replaces files while they are read; whatever else is wrong stays wrong.
                with UntrustedFolder(self.folder) as folder:
                    if all(name in self.stored_frames or folder.is_file(name) for name in names):
                        raise
                continue
            with UntrustedFolder(self.folder) as folder:
                if poses == poses_state(folder):
                    return Checkpoint(self._job.attempt, stage, step, files)
        return None

    def _checkpoint_files(self, folder: UntrustedFolder, stage: str) -> list[str]:
        if stage == "render":
            return self.stored_frames.checkpoint_names()
        return checkpoint_files(folder, stage, self._own_block)

    def store_results(self) -> Manifest:
        """Store the results without publishing them."""
        manifest = store_tree(
            self.storage,
            self.folder,
            below=RESULTS_FOLDER,
            metadata={"job": str(self._job.id), "attempt": self._job.attempt, "kind": self._job.kind},
        )
        files = merge_files(manifest.files, self.stored_frames.results())
        return manifest.model_copy(update={"files": files})

    def publish_results(self, manifest: Manifest) -> list[ResultFile]:
        """Publish the manifest of the stored results; the job's row makes them visible."""
        if not publish_manifest(self.storage, _results_document(self._job, self._job.attempt), manifest):
            raise StorageError("Another result was published for this attempt; ask for a retry.")
        return _result_files(manifest)

    def withdraw_results(self) -> None:
        """Withdraw the manifests of this attempt, and of earlier ones that it would begin with."""
        for attempt in range(self._job.attempt, self._job.fresh_after, -1):
            self.storage.remove_document(_results_document(self._job, attempt))

    def store_partial_results(self) -> list[ResultFile]:
        """Store the finished results of a failed program; only its job's row shows them."""
        return _result_files(store_tree(self.storage, self.folder, below=RESULTS_FOLDER))

    def read_psnr(self, results: Sequence[ResultFile]) -> float | None:
        """Return the mean PSNR over the held-out views in dB; None if the results have none."""
        for result in results:
            if result.name == METRICS_FILE and result.size_bytes <= MAX_METRICS_BYTES:
                try:
                    mean = json.loads(b"".join(self.storage.read(result.sha256)))["mean"]["psnr"]
                except (StorageError, ValueError, TypeError, KeyError, RecursionError):
                    return None
                return float(mean) if isinstance(mean, int | float) and math.isfinite(mean) else None
        return None

    def find_published_results(self) -> list[ResultFile] | None:
        """Return results that an earlier attempt published but could not record."""
        for attempt in range(self._job.attempt - 1, self._job.fresh_after, -1):
            manifest = read_manifest(self.storage, _results_document(self._job, attempt))
            if manifest is not None:
                return _result_files(manifest)
        return None

    def store_file(self, name: str) -> str:
        """Store one file of the folder and return its digest."""
        return store_tree(self.storage, self.folder, [name]).files[0].sha256

    def _store_files(self, names: Sequence[str]) -> tuple[TreeFile, ...]:
        """Store files; finished frames never change, so that each of them is read once."""
        new = [name for name in names if name not in self.stored_frames]
        files = {file.path: file for file in store_tree(self.storage, self.folder, new).files}
        self.stored_frames.add(files.values())
        return tuple(files[name] if name in files else self.stored_frames[name] for name in names)


def _tree_files(files: Sequence[DatasetFile]) -> list[TreeFile]:
    return [TreeFile(path=f.path, sha256=f.sha256, size_bytes=f.size_bytes) for f in files]


def _result_files(manifest: Manifest) -> list[ResultFile]:
    return [ResultFile(f.path, f.sha256, f.size_bytes, media_type(f.path)) for f in manifest.files]


def _results_document(job: Job, attempt: int) -> str:
    return f"results/{job.id}/{attempt}"
