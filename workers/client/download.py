"""Results to a folder; a download that broke off goes on, and every digest is verified."""

import hashlib
import urllib.parse
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx

from octasplat.engine.core.errors import OutputError
from octasplat.engine.core.portable_names import NameSet
from octasplat.workers.client.api import (
    BUSY_STATUSES,
    UNAVAILABLE_STATUSES,
    Api,
    ServiceError,
    ServiceUnreachableError,
)

MAX_DAMAGED_DOWNLOADS = 3
"""So often a file is fetched anew whose content is not what it should be."""


def download_results(
    api: Api,
    job_id: str,
    folder: Path,
    *,
    names: tuple[str, ...] = (),
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> list[Path]:
    """Save the results of a job.

    Args:
        api: the service.
        job_id: which.
        folder: where to; files that are there with the right content are left alone.
        names: only these results.
        progress: called with (bytes done, total).

    Returns:
        The files.

    Raises:
        ServiceError: there is no such job or result.
        OutputError: a file cannot be written.
    """
    found = api.get(f"/v1/jobs/{job_id}/artifacts")["artifacts"]
    chosen = [artifact for artifact in found if not names or artifact["name"] in names]
    missing = set(names) - {artifact["name"] for artifact in chosen}
    if missing or not found:
        what = f"no result {', '.join(sorted(missing))}" if missing else "no results"
        raise ServiceError(f"The job {job_id} has {what}; see octasplat status {job_id}.")
    safe = NameSet()
    total = sum(artifact["size_bytes"] for artifact in chosen)
    done = 0
    progress(0, total)
    paths = []
    for artifact in chosen:
        safe.add(artifact["name"])  # a service is not trusted with the paths of this machine
        path = folder / artifact["name"]
        before = done

        def report(count: int, before: int = before) -> None:
            progress(before + count, total)

        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _download_file(api, job_id, artifact, path, report)
        except OSError as error:
            raise OutputError(f"{path} cannot be written ({error.strerror or error}).") from None
        done += artifact["size_bytes"]
        progress(done, total)
        paths.append(path)
    return paths


def download_archive(
    api: Api,
    job_id: str,
    path: Path,
    *,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Path:
    """Save all results of a job as one ZIP file, which replaces a file of that name once it is whole.

    Args:
        api: the service.
        job_id: which.
        path: the ZIP file.
        progress: called with (bytes done, total of the results).

    Raises:
        ServiceError: there is no such job, or it has no results.
        ServiceUnreachableError: the service does not answer, or broke off.
        OutputError: the file cannot be written, or came damaged.
    """
    found = api.get(f"/v1/jobs/{job_id}/artifacts")["artifacts"]
    total = sum(artifact["size_bytes"] for artifact in found)
    partial = path.with_name(f".{job_id}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with api.stream("GET", f"/v1/jobs/{job_id}/archive") as response, partial.open("wb") as handle:
            api.raise_for_stream_status(response)
            for piece in response.iter_raw():
                handle.write(piece)
                progress(min(handle.tell(), total), total)
        with zipfile.ZipFile(partial) as archive:
            damaged = archive.testzip()
        if damaged is not None:
            raise OutputError(f"{path} came damaged at {damaged}; ask for it again.")
        partial.replace(path)
    except httpx.TransportError as error:
        raise api.unreachable_error(error) from None
    except zipfile.BadZipFile:
        raise OutputError(f"{path} came damaged; ask for it again.") from None
    except OSError as error:
        raise OutputError(f"{path} cannot be written ({error.strerror or error}).") from None
    finally:
        partial.unlink(missing_ok=True)
    return path


def _download_file(
    api: Api, job_id: str, artifact: dict[str, Any], path: Path, on_bytes: Callable[[int], None]
) -> None:
    if path.is_file() and _sha256(path) == artifact["sha256"]:
        return
    partial = path.with_name(f".{artifact['sha256'][:24]}.partial")  # short, as the name may be very long
    address = f"/v1/jobs/{job_id}/artifacts/{urllib.parse.quote(artifact['name'])}"
    patience, damaged = api.new_backoff(), 0
    while damaged < MAX_DAMAGED_DOWNLOADS:
        before = _file_size(partial)
        try:
            _resume_download(api, address, artifact, partial, on_bytes)
        except (httpx.TransportError, ServiceUnreachableError, ServiceError) as error:
            if isinstance(error, ServiceError) and error.status not in BUSY_STATUSES | UNAVAILABLE_STATUSES:
                raise
            if _file_size(partial) > before:
                patience.reset()
            if not patience.wait():
                raise (
                    api.unreachable_error(error) if isinstance(error, httpx.TransportError) else error
                ) from None
            continue
        if _sha256(partial) == artifact["sha256"]:
            partial.replace(path)
            return
        partial.unlink()
        damaged += 1
    raise OutputError(f"{path} came damaged {damaged} times; the store of the service needs to be looked at.")


def _resume_download(
    api: Api, address: str, artifact: dict[str, Any], partial: Path, on_bytes: Callable[[int], None]
) -> None:
    begin = _file_size(partial)
    if begin >= artifact["size_bytes"]:
        # No request, as an empty result has no byte to ask for.
        partial.touch()
        return
    # Compressed, the offsets would not be those of the file.
    headers = {"Accept-Encoding": "identity"}
    if begin:
        headers |= {"Range": f"bytes={begin}-", "If-Range": f'"{artifact["sha256"]}"'}
    with api.stream("GET", address, headers=headers) as response:
        api.raise_for_stream_status(response)
        # Only if the rest is of the same content, see If-Range; else all of it comes.
        is_partial = response.status_code == 206
        with partial.open("ab" if is_partial else "wb") as handle:
            for piece in response.iter_bytes():
                handle.write(piece)
                on_bytes(handle.tell())


def _file_size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
