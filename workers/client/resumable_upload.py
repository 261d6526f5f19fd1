"""One large file to a dataset, over breaks of the connection, the service and this process.

Its parts go over several connections at once; a service of the former version gets them in order (tus 1.0.0).
"""

import base64
import hashlib
from collections.abc import Callable
from pathlib import Path
from threading import Semaphore
from urllib.parse import quote

import httpx

from octasplat.workers.client.api import (
    BUSY_STATUSES,
    UNAVAILABLE_STATUSES,
    Api,
    ServiceError,
    ServiceUnreachableError,
)
from octasplat.workers.client.dataset_tasks import wait_for_task
from octasplat.workers.client.upload_parts import PARALLEL_PARTS, FileRange, Upload, file_size, send_parts

MIN_RESUMABLE_BYTES = 32 << 20
"""Smaller files are sent in one request, and again from their beginning."""
REQUEST_BYTES = 256 << 20
"""Most that one request sends, as proxies limit the time of one."""
MAX_STORED_BEFORE = 30
"""So often the same file may have been sent to the same dataset before, and removed there."""
_VERSION = {"Tus-Resumable": "1.0.0"}
_CONFLICT, _NOT_FOUND = httpx.codes.CONFLICT, httpx.codes.NOT_FOUND


def send_resumable(
    api: Api,
    dataset_id: str,
    path: Path,
    name: str | None,
    sha256: str,
    progress: Callable[[int], None] = lambda _done: None,
    connections: Semaphore | None = None,
) -> None:
    """Send a file and wait until it is stored; the same call again goes on with what has arrived.

    Args:
        api: the service.
        dataset_id: where the file belongs.
        path: the file.
        name: what it is called there; None for a ZIP file that is unpacked.
        sha256: its digest.
        progress: called with the bytes that have gone out.
        connections: taken for each part, as other files may be sent meanwhile; by default of its own.

    Raises:
        DatasetError: it cannot be read, or has become shorter.
        ServiceError: the service refuses it.
        ServiceUnreachableError: the service was away for too long.
    """
    upload = _find_or_create(api, dataset_id, name, sha256, file_size(path))
    if upload is None:
        return
    task = None
    try:
        if upload.can_take_parts:
            task = send_parts(api, upload, path, progress, connections or Semaphore(PARALLEL_PARTS))
        if task is None:
            task = _send_in_order(api, upload, path, progress)
    except ServiceError as error:
        # The answer to the last part was lost, and the file was stored before it was asked for again.
        if error.status == _NOT_FOUND and _is_stored(api, dataset_id, name, sha256):
            return
        raise
    wait_for_task(api, api.get(task))


def _is_stored(api: Api, dataset_id: str, name: str | None, sha256: str) -> bool:
    """Return whether a dataset has a file, or what was in a ZIP file, whose upload is over.

    Raises:
        ServiceError: the content of the ZIP file was refused.
    """
    if name is None:
        # An archive is sent to a dataset of its own.
        tasks = api.get(f"/v1/datasets/{dataset_id}/tasks", limit=1)["tasks"]
        return bool(tasks) and tasks[0]["kind"] == "upload" and bool(wait_for_task(api, tasks[0]))
    try:
        answer = api.request("HEAD", f"/v1/datasets/{dataset_id}/files/{quote(name)}")
    except ServiceError as error:
        if error.status != _NOT_FOUND:
            raise
        return False
    return answer.headers.get("ETag") == f'"{sha256}"'


def _send_in_order(api: Api, upload: Upload, path: Path, progress: Callable[[int], None]) -> str:
    """Send what is lacking of a file behind what has come; returns the address of the task that stores it."""
    address, size = upload.address, upload.size_bytes
    patience = api.new_backoff()
    offset, task = _offset(api, address), None
    while task is None:
        progress(offset)
        headers = {
            **_VERSION,
            "Upload-Offset": str(offset),
            "Content-Type": "application/offset+octet-stream",
            "Content-Length": str(min(REQUEST_BYTES, size - offset)),
        }
        content = FileRange(path, offset, min(offset + REQUEST_BYTES, size), progress)
        try:
            response = api.send("PATCH", address, headers=headers, content=content)
        except (httpx.TransportError, ServiceUnreachableError) as error:
            if not patience.wait():
                raise api.unreachable_error(error) from None
            reached = _offset(api, address)
        except ServiceError as error:
            # Another connection, perhaps that of before, has brought more; or it is to be repeated.
            is_passing = error.status in {_CONFLICT, *BUSY_STATUSES, *UNAVAILABLE_STATUSES}
            if not is_passing or not patience.wait(error.retry_seconds):
                raise
            reached = _offset(api, address)
        else:
            reached, task = int(response.headers["Upload-Offset"]), response.headers.get("Location")
        if reached > offset:
            # An outage after progress is a new one, with all of its time.
            patience = api.new_backoff()
        offset = reached
    return str(task)


def _find_or_create(api: Api, dataset_id: str, name: str | None, sha256: str, size: int) -> Upload | None:
    """Return the upload of this file, a new one unless one is under way; None if a ZIP file is stored."""
    metadata = {"sha256": sha256} if name is None else {"path": name, "sha256": sha256}
    encoded = (f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in metadata.items())
    headers = {**_VERSION, "Upload-Length": str(size), "Upload-Metadata": ",".join(encoded)}
    key = "upload-" + hashlib.sha256(f"{dataset_id}\n{name}\n{sha256}".encode()).hexdigest()
    for number in range(MAX_STORED_BEFORE):
        headers["Idempotency-Key"] = f"{key}-{number}"
        try:
            response = api.request("POST", f"/v1/datasets/{dataset_id}/uploads", headers=headers)
        except ServiceError as error:
            if error.status != _NOT_FOUND:  # it was stored or given up since, and the next one may be there
                raise
            if name is None and _was_unpacked(api, dataset_id):
                return None
        else:
            return Upload.from_answer(str(response.headers["Location"]), response.json())
    raise ServiceError(f"The file was sent {MAX_STORED_BEFORE} times before; make a new dataset.")


def _was_unpacked(api: Api, dataset_id: str) -> bool:
    """Return whether the ZIP file whose upload is over has been stored, as after its sender was killed."""
    tasks = api.iterate_pages(f"/v1/datasets/{dataset_id}/tasks", "tasks")
    newest = next((task for task in tasks if task["kind"] == "upload"), None)
    return newest is not None and newest["state"] == "succeeded"


def _offset(api: Api, address: str) -> int:
    return int(api.request("HEAD", address, headers=_VERSION).headers["Upload-Offset"])
