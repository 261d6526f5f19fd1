"""A folder of photographs to a dataset; what has arrived before is not sent again."""

import base64
import hashlib
import threading
import urllib.parse
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.scene_layout import is_ignored_file
from octasplat.workers.client.api import Api, ServiceError
from octasplat.workers.client.dataset_tasks import commit
from octasplat.workers.client.resumable_upload import MIN_RESUMABLE_BYTES, send_resumable

PARALLEL_UPLOADS = 4
MAX_DELETED_DATASETS = 30
"""So many datasets of one folder that were deleted are looked past for one that is there."""
_PIECE_BYTES = 1 << 20
_ARCHIVE_END_BYTES = 1 << 18
"""So much of the end of an archive is shown first; it holds the names of a thousand files."""
_ARCHIVE_END_TRIES = 4
"""The list of contents may ask for more three times: its end record, that of ZIP64, and itself."""


@dataclass(frozen=True)
class LocalFile:
    """A file to send: its name in the dataset and where it is."""

    name: str
    path: Path
    size_bytes: int


def list_scene_files(
    api: Api, scene: Path, on_warning: Callable[[str], None] = lambda _sentence: None
) -> list[LocalFile]:
    """Return the files of a scene folder that the service takes, by name; what it leaves out is told.

    Raises:
        DatasetError: it is no folder, or the service would refuse it.
        ServiceError: the service cannot be asked.
    """
    if not scene.is_dir():
        raise DatasetError(f"{scene} is not a folder; name the folder that holds images/ and sparse/.")
    found = (path for path in sorted(scene.rglob("*")) if path.is_file())
    paths = {_replace_non_utf8(path.relative_to(scene).as_posix()): path for path in found}
    listed = [
        {"path": name, "size_bytes": path.stat().st_size}
        for name, path in paths.items()
        if not is_ignored_file(name)
    ]
    preview = api.post("/v1/scene-previews", {"files": listed})
    _tell_preview(scene, preview, on_warning)
    files = [LocalFile(file["name"], paths[file["path"]], file["size_bytes"]) for file in preview["files"]]
    for file in files:
        if _replace_non_utf8(str(file.path)) != str(file.path):
            raise DatasetError(f"The name of {str(file.path)!a} is not UTF-8; rename the file.")
    return files


def _replace_non_utf8(name: str) -> str:
    """Return a name with what is not UTF-8 in it replaced, as JSON cannot hold it."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def _preview_archive(api: Api, archive: Path, on_warning: Callable[[str], None]) -> None:
    """Tell what the service would leave out of a ZIP file, by the list of contents at its end.

    Raises:
        DatasetError: the service would refuse it.
    """
    size, needed = archive.stat().st_size, _ARCHIVE_END_BYTES
    for _ in range(_ARCHIVE_END_TRIES):
        with archive.open("rb") as file:
            file.seek(max(0, size - needed))
            end = file.read()
        headers = {"Content-Type": "application/octet-stream"}
        preview = api.request(
            "POST", f"/v1/scene-previews/archive?size_bytes={size}", content=end, headers=headers
        ).json()
        needed = preview["needed_bytes"]
        if needed is None or needed <= len(end):
            break
    _tell_preview(archive, preview, on_warning)


def _tell_preview(scene: Path, preview: Mapping[str, Any], on_warning: Callable[[str], None]) -> None:
    for sentence in preview["notes"]:
        on_warning(sentence)
    if preview["refusals"]:
        refusals = " ".join(dict.fromkeys(refusal["detail"] for refusal in preview["refusals"]))
        raise DatasetError(f"{scene} cannot be sent: {refusals}")


def upload_scene(
    api: Api,
    scene: Path,
    *,
    name: str | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
    on_warning: Callable[[str], None] = lambda _sentence: None,
) -> dict[str, Any]:
    """Send a scene and commit it; the same command again goes on with the same dataset.

    Args:
        api: the service.
        scene: a folder with ``images/``, a bare folder of photographs, or a ZIP file.
        name: what to call it; by default as the folder.
        progress: called with (bytes done, total).
        on_warning: called with a sentence on which files are left out, before anything is sent.

    Returns:
        The dataset.

    Raises:
        DatasetError: the service would refuse the scene, which is not sent.
        ServiceError: the service refuses it; the text names the files.
    """
    is_archive = scene.is_file()
    if is_archive:
        files = [LocalFile(scene.name, scene, scene.stat().st_size)]
        _preview_archive(api, scene, on_warning)
    else:
        files = list_scene_files(api, scene, on_warning)
    dataset = _find_or_create_dataset(api, name or scene.resolve().stem, files)
    if dataset["state"] == "open":
        if is_archive:
            _send_archive(api, dataset["id"], files[0], progress)
        else:
            _send_missing(api, dataset["id"], files, progress)
    return commit(api, dataset)


def upload_files(
    api: Api,
    files: Mapping[str, Path],
    *,
    name: str = "",
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> dict[str, Any]:
    """Send files that the options of a job name; the same call again goes on with the same dataset.

    Args:
        api: the service.
        files: where they are, by the names that the options call them.
        name: what to call the dataset.
        progress: called with (bytes done, total).

    Returns:
        The dataset, committed; a job gets it as ``files_id``.

    Raises:
        ServiceError: the service refuses it; the text names the files.
    """
    local = [LocalFile(called, path, path.stat().st_size) for called, path in sorted(files.items())]
    dataset = _find_or_create_dataset(api, name, local, holds="files")
    if dataset["state"] == "open":
        _send_missing(api, dataset["id"], local, progress)
    return commit(api, dataset)


def _find_or_create_dataset(
    api: Api, name: str, files: Iterable[LocalFile], holds: str = "photographs"
) -> dict[str, Any]:
    """Return the dataset that was made for just these files, or a new one."""
    digest = hashlib.sha256(f"{holds}\0{name}".encode() if holds == "files" else name.encode())
    for file in files:
        # In the place of the contents, which would all have to be read first.
        facts = file.path.stat()
        digest.update(f"{file.name}\0{facts.st_size}\0{facts.st_mtime_ns}\0{facts.st_ino}\n".encode())
    body = {"name": name, "holds": holds} if holds == "files" else {"name": name}
    key = f"scene-{digest.hexdigest()}"
    for number in range(MAX_DELETED_DATASETS):
        try:
            found: dict[str, Any] = api.post("/v1/datasets", body, key=f"{key}-{number}" if number else key)
        except ServiceError as error:
            if error.status != 404:  # it was deleted since, and the next one may be there
                raise
        else:
            return found
    made: dict[str, Any] = api.post("/v1/datasets", body, key=uuid.uuid4().hex)
    return made


def _send_missing(
    api: Api, dataset_id: str, files: list[LocalFile], progress: Callable[[int, int], None]
) -> None:
    there = {f["path"]: f for f in api.iterate_pages(f"/v1/datasets/{dataset_id}/files", "files", limit=5000)}
    names = {file.name for file in files}
    # What an earlier try has sent and the folder does not hold any more.
    for path in there.keys() - names:
        try:
            api.request("DELETE", _file_address(dataset_id, path))
        except ServiceError as error:
            if error.status != 404:  # an earlier try, whose answer was lost, has removed it
                raise
    counter = _ProgressCounter(sum(file.size_bytes for file in files), progress)

    def send(file: LocalFile) -> None:
        sha256 = _sha256(file.path)
        known = there.get(file.name)
        is_there = known is not None and known["sha256"] == sha256
        if not is_there and file.size_bytes >= MIN_RESUMABLE_BYTES:
            with counter.part() as tell:
                send_resumable(api, dataset_id, file.path, file.name, sha256, tell)
        elif not is_there:
            _put_file(api, _file_address(dataset_id, file.name), file.path, sha256)
        counter.add(file.size_bytes)

    with ThreadPoolExecutor(PARALLEL_UPLOADS) as pool:
        jobs = [pool.submit(send, file) for file in files]
        try:
            done, _ = wait(jobs, return_when=FIRST_EXCEPTION)
        finally:
            # What is being sent is sent to its end; what has not begun does not begin.
            pool.shutdown(wait=True, cancel_futures=True)
    for job in done:
        job.result()


def _send_archive(api: Api, dataset_id: str, file: LocalFile, progress: Callable[[int, int], None]) -> None:
    progress(0, file.size_bytes)
    sha256 = _sha256(file.path)
    if file.size_bytes >= MIN_RESUMABLE_BYTES:
        send_resumable(api, dataset_id, file.path, None, sha256, lambda done: progress(done, file.size_bytes))
    else:
        _put_file(api, f"/v1/datasets/{dataset_id}/archive", file.path, sha256)
    progress(file.size_bytes, file.size_bytes)


def _put_file(api: Api, address: str, path: Path, sha256: str) -> Any:
    encoded = base64.b64encode(bytes.fromhex(sha256)).decode()
    headers = {
        "Repr-Digest": f"sha-256=:{encoded}:",
        "Content-Type": "application/octet-stream",
        "Content-Length": str(path.stat().st_size),
    }
    return api.request("PUT", address, content=_RereadableFile(path), headers=headers)


class _RereadableFile:
    """A file's content that can be sent again when the first try breaks off."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __iter__(self) -> Iterator[bytes]:
        with self._path.open("rb") as handle:
            while piece := handle.read(_PIECE_BYTES):
                yield piece


class _ProgressCounter:
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
            self.add(done - reported)
            reported = done

        try:
            yield tell
        finally:
            # send() counts the whole file when it is there.
            tell(0)

    def add(self, count: int) -> None:
        """Count bytes that have gone out."""
        with self._lock:
            self._done += count
            self._progress(self._done, self._total)


def _file_address(dataset_id: str, name: str) -> str:
    return f"/v1/datasets/{dataset_id}/files/{urllib.parse.quote(name)}"


def _sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
