"""Files of a dataset, sent over several connections at once; what the service has is not sent again."""

import base64
import hashlib
import threading
import urllib.parse
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octasplat.workers.client.api import Api, ServiceError
from octasplat.workers.client.resumable_upload import MIN_RESUMABLE_BYTES, send_resumable
from octasplat.workers.client.upload_parts import FileRange, file_size, unreadable_error

PARALLEL_UPLOADS = 4
MAX_ASKED_FILES = 500
"""Files that the service is asked for at once; the next ones are read meanwhile."""
MAX_ASKED_BYTES = 1 << 18
"""Length of such a request, about; a service takes a megabyte."""
_BYTES_BESIDE_NAME = 100


@dataclass(frozen=True)
class LocalFile:
    """A file to send: its name in the dataset and where it is."""

    name: str
    path: Path
    size_bytes: int


def send_files(
    api: Api, dataset_id: str, files: Sequence[LocalFile], progress: Callable[[int, int], None]
) -> list[LocalFile]:
    """Make a dataset hold just these files; the same call again goes on with what has arrived.

    Args:
        api: the service.
        dataset_id: the dataset, which is open.
        files: by name.
        progress: called with (bytes sent, total); what need not be sent leaves the total.

    Returns:
        Those files that were not sent, as the dataset, or another one of its owner, has them already.

    Raises:
        DatasetError: one cannot be read, or has become shorter while it was sent.
        ServiceError: the service refuses one; the text names it.
        ServiceUnreachableError: the service was away for too long.
    """
    there = keep_files(api, dataset_id, {file.name for file in files})
    counter = ProgressCounter(sum(file.size_bytes for file in files), progress)
    unsent: list[LocalFile] = []
    jobs: list[Future[None]] = []

    connections, is_given_up = threading.Semaphore(PARALLEL_UPLOADS), threading.Event()

    def send(file: LocalFile, sha256: str) -> None:
        if file.size_bytes >= MIN_RESUMABLE_BYTES:
            with counter.part() as tell:

                def tell_unless_given_up(done: int) -> None:
                    if is_given_up.is_set():
                        raise _GivenUpError
                    tell(done)

                send_resumable(
                    api, dataset_id, file.path, file.name, sha256, tell_unless_given_up, connections
                )
        else:
            with connections:
                put_file(api, _file_address(dataset_id, file.name), file.path, sha256)
        counter.add(file.size_bytes)

    with ThreadPoolExecutor(PARALLEL_UPLOADS) as reading, ThreadPoolExecutor(PARALLEL_UPLOADS) as sending:
        try:
            for batch in _batches(files):
                digests = dict(zip(batch, reading.map(sha256_of, [f.path for f in batch]), strict=True))
                asked = {f.name: digest for f, digest in digests.items() if there.get(f.name) != digest}
                to_send = asked.keys() - _reuse_files(api, dataset_id, asked)
                for file, digest in digests.items():
                    if file.name in to_send:
                        jobs.append(sending.submit(send, file, digest))
                    else:
                        unsent.append(file)
                        counter.leave_out(file.size_bytes)
                _raise_failure(jobs)
            wait(jobs, return_when=FIRST_EXCEPTION)
        finally:
            # What has not begun does not begin; of large files, which may take hours, what has come is kept.
            is_given_up.set()
            sending.shutdown(wait=True, cancel_futures=True)
    _raise_failure(jobs)
    return unsent


def keep_files(api: Api, dataset_id: str, names: Set[str]) -> dict[str, str]:
    """Return the digests of those files, by name, that a dataset has; others of an earlier try are removed.

    Raises:
        ServiceError: the dataset is not open.
        ServiceUnreachableError: the service was away for too long.
    """
    listed = api.iterate_pages(f"/v1/datasets/{dataset_id}/files", "files", limit=5000)
    there: dict[str, str] = {file["path"]: file["sha256"] for file in listed}
    for name in there.keys() - names:
        try:
            api.request("DELETE", _file_address(dataset_id, name))
        except ServiceError as error:
            if error.status != 404:  # an earlier try, whose answer was lost, has removed it
                raise
    return {name: sha256 for name, sha256 in there.items() if name in names}


def put_file(api: Api, address: str, path: Path, sha256: str) -> Any:
    """Send a file in one request, with its digest.

    Raises:
        DatasetError: it cannot be read, or has become shorter.
        ServiceError: the service refuses it, as one that has changed since its digest was taken.
        ServiceUnreachableError: the service was away for too long.
    """
    encoded = base64.b64encode(bytes.fromhex(sha256)).decode()
    size = file_size(path)
    headers = {
        "Repr-Digest": f"sha-256=:{encoded}:",
        "Content-Type": "application/octet-stream",
        "Content-Length": str(size),
    }
    return api.request("PUT", address, content=FileRange(path, 0, size), headers=headers)


def sha256_of(path: Path) -> str:
    """Return the digest of a file, in hexadecimal.

    Raises:
        DatasetError: it cannot be read.
    """
    try:
        with path.open("rb") as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()
    except OSError as error:
        raise unreadable_error(path, error) from None


def describe_unsent(unsent: Sequence[LocalFile], count: int) -> str | None:
    """Return a sentence on the files, of so many, that were not sent; None where all were."""
    if not unsent:
        return None
    size = _format_size(sum(file.size_bytes for file in unsent))
    if len(unsent) == 1:
        return f"{unsent[0].name} ({size}) was not sent, as the service has it already."
    which = (
        f"None of the {count} files ({size}) was"
        if len(unsent) == count
        else (f"{len(unsent)} of the {count} files ({size}) were not")
    )
    return f"{which} sent, as the service has them already."


def _format_size(size_bytes: int) -> str:
    for unit, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if size_bytes >= unit:
            return f"{size_bytes / unit:.1f} {name}"
    return f"{size_bytes} bytes"


def _reuse_files(api: Api, dataset_id: str, digests: Mapping[str, str]) -> set[str]:
    """Return which files, by their digests, the service has taken from what their owner stored before."""
    if not digests:
        return set()
    body = {"files": [{"path": name, "sha256": sha256} for name, sha256 in digests.items()]}
    try:
        answer = api.post(f"/v1/datasets/{dataset_id}/files", body)
    except ServiceError as error:
        if error.status != 405:  # a service of the former version, which has to be sent all
            raise
        return set()
    return {file["path"] for file in answer["files"]}


def _batches(files: Sequence[LocalFile]) -> Iterator[list[LocalFile]]:
    """Yield the files in lists, each for one request that asks for them."""
    batch, length = list[LocalFile](), 0
    for file in files:
        own = len(file.name.encode()) + _BYTES_BESIDE_NAME
        if batch and (len(batch) == MAX_ASKED_FILES or length + own > MAX_ASKED_BYTES):
            yield batch
            batch, length = [], 0
        batch.append(file)
        length += own
    if batch:
        yield batch


def _raise_failure(jobs: Sequence[Future[None]]) -> None:
    """Raise what the first of the uploads that failed so far raised; others may have been given up for it."""
    for job in jobs:
        if job.done() and not job.cancelled():
            with suppress(_GivenUpError):
                job.result()


class _GivenUpError(Exception):
    """A file is not sent on, as another one failed or whoever asked for it has gone."""


class ProgressCounter:
    """Counts bytes of several threads.

    Args:
        total: of all of them.
        progress: called with (bytes done, total).
    """

    def __init__(self, total: int, progress: Callable[[int, int], None]) -> None:
        self._done, self._total, self._progress = 0, total, progress
        self._lock = threading.Lock()
        progress(0, total)

    @contextmanager
    def part(self) -> Iterator[Callable[[int], None]]:
        """Yield what tells how much of a file has gone out, which counts until the file is there."""
        reported = 0

        def tell(done: int) -> None:
            nonlocal reported
            if done != reported:
                self.add(done - reported)
                reported = done

        try:
            yield tell
        finally:
            # The whole file is counted when it is there.
            tell(0)

    def add(self, count: int) -> None:
        """Count bytes that have gone out."""
        with self._lock:
            self._done += count
            self._progress(self._done, self._total)

    def leave_out(self, count: int) -> None:
        """Count bytes of the total as none that go out."""
        with self._lock:
            self._total -= count
            self._progress(self._done, self._total)


def _file_address(dataset_id: str, name: str) -> str:
    return f"/v1/datasets/{dataset_id}/files/{urllib.parse.quote(name)}"
