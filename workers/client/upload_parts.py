"""Parts of one large file, sent over several connections at once, each with its digest."""

import base64
import hashlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Semaphore
from typing import Any

from octasplat.engine.core.errors import DatasetError
from octasplat.workers.client.api import Api, ServiceError

PARALLEL_PARTS = 4
_PIECE_BYTES = 1 << 20


@dataclass(frozen=True)
class Upload:
    """An upload of one file, as the service told of it.

    Attributes:
        address: where it is.
        size_bytes: length of the file.
        offset_bytes: how much has come in order.
        part_bytes: length of parts in any order; 0 for a service of the former version.
        parts_ahead: where those begin that have come, though not all before them has.
    """

    address: str
    size_bytes: int
    offset_bytes: int
    part_bytes: int
    parts_ahead: frozenset[int]

    @classmethod
    def from_answer(cls, address: str, view: Mapping[str, Any]) -> "Upload":
        """Return the upload of an answer."""
        return cls(
            address,
            view["size_bytes"],
            view["offset_bytes"],
            view.get("part_bytes", 0),
            frozenset(view.get("parts_ahead", ())),
        )

    @property
    def can_take_parts(self) -> bool:
        """Return whether parts in any order can follow what has come."""
        return (
            self.part_bytes > 0
            and self.offset_bytes < self.size_bytes
            and self.offset_bytes % self.part_bytes == 0
        )


class FileRange:
    """A part of a file's content, which can be sent again when the first try breaks off.

    Args:
        path: the file.
        start: where the part begins.
        stop: where it ends.
        progress: called with how far in the file it has gone out.
    """

    def __init__(
        self, path: Path, start: int, stop: int, progress: Callable[[int], None] = lambda _done: None
    ) -> None:
        self._path, self._start, self._stop, self._progress = path, start, stop, progress

    def __iter__(self) -> Iterator[bytes]:
        """Yield the content in pieces.

        Raises:
            DatasetError: the file cannot be read, or has become shorter.
        """
        offset = self._start
        for piece in self._read_pieces():
            yield piece
            offset += len(piece)
            self._progress(offset)

    def sha256(self) -> bytes:
        """Return the digest of the part.

        Raises:
            DatasetError: as when it is sent.
        """
        digest = hashlib.sha256()
        for piece in self._read_pieces():
            digest.update(piece)
        return digest.digest()

    def _read_pieces(self) -> Iterator[bytes]:
        left = self._stop - self._start
        try:
            with self._path.open("rb") as handle:
                handle.seek(self._start)
                while left:
                    piece = handle.read(min(_PIECE_BYTES, left))
                    if not piece:
                        raise DatasetError(
                            f"{self._path} became shorter while it was sent; send it when it is complete."
                        )
                    left -= len(piece)
                    yield piece
        except OSError as error:
            raise unreadable_error(self._path, error) from None


def file_size(path: Path) -> int:
    """Return the length of a file.

    Raises:
        DatasetError: it is not there.
    """
    try:
        return path.stat().st_size
    except OSError as error:
        raise unreadable_error(path, error) from None


def unreadable_error(path: Path, error: OSError) -> DatasetError:
    """Return what to tell of a file that cannot be read."""
    return DatasetError(f"{path} cannot be read ({error.strerror or error}).")


def send_parts(
    api: Api, upload: Upload, path: Path, progress: Callable[[int], None], connections: Semaphore
) -> str | None:
    """Send the parts that are lacking.

    Args:
        api: the service.
        upload: the upload.
        path: the file.
        progress: called with the bytes that have gone out.
        connections: taken for each part that is sent.

    Returns:
        The address of the task that stores the file; None where the rest has to be sent in order, as other
        content has come meanwhile, or a front end of the former version answers.

    Raises:
        ServiceError: the service refuses a part.
        ServiceUnreachableError: the service was away for too long.
    """
    starts = [
        start
        for start in range(upload.offset_bytes, upload.size_bytes, upload.part_bytes)
        if start not in upload.parts_ahead
    ]
    sent = _SentBytes(upload, starts, progress)
    tasks: list[str] = []

    def send(start: int) -> None:
        stop = min(start + upload.part_bytes, upload.size_bytes)
        with connections:
            content = FileRange(path, start, stop, lambda reached: sent.record(start, reached - start))
            headers = {
                "Repr-Digest": f"sha-256=:{base64.b64encode(content.sha256()).decode()}:",
                "Content-Type": "application/octet-stream",
                "Content-Length": str(stop - start),
            }
            answer = api.request("PUT", f"{upload.address}/parts/{start}", headers=headers, content=content)
        if (task := answer.headers.get("Location")) is not None:
            tasks.append(task)

    with ThreadPoolExecutor(PARALLEL_PARTS) as pool:
        jobs = [pool.submit(send, start) for start in starts]
        try:
            done, _ = wait(jobs, return_when=FIRST_EXCEPTION)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)
    try:
        for job in done:
            job.result()
    except ServiceError as error:
        if error.status not in (404, 405, 409):
            raise
        return None
    return tasks[-1] if tasks else None


class _SentBytes:
    """Tells how much of a file has gone out, while several of its parts go out.

    Args:
        upload: the upload.
        starts: where the parts begin that are to be sent.
        progress: called with the sum.
    """

    def __init__(self, upload: Upload, starts: list[int], progress: Callable[[int], None]) -> None:
        lacking = sum(min(upload.part_bytes, upload.size_bytes - start) for start in starts)
        self._before = upload.size_bytes - lacking
        self._parts: dict[int, int] = {}
        self._progress = progress
        self._lock = Lock()
        progress(self._before)

    def record(self, start: int, count: int) -> None:
        """Record how much of the part that begins at ``start`` has gone out; less where it is sent again."""
        with self._lock:
            self._parts[start] = count
            self._progress(self._before + sum(self._parts.values()))
