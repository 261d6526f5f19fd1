"""Datasets that are made once, and tasks on them that are waited for, such as commits and imports."""

import hashlib
import time
import uuid
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import urlsplit

import httpx

from octasplat.workers.client.api import Api, ServiceError, problem_error
from octasplat.workers.client.backoff import Backoff

MAX_CHECK_WAIT_SECONDS = 600.0
"""For so long a check of a dataset that a front end of the former version has begun is waited for."""
MAX_DELETED_DATASETS = 30
"""So many datasets of the same files that were deleted are looked past for one that is there."""
_FIRST_PAUSE_SECONDS, _LAST_PAUSE_SECONDS = 0.2, 3.0


def create_dataset_once(api: Api, body: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return the dataset that was made with a key before, or a new one.

    Raises:
        ServiceError: the owner has too many datasets.
        ServiceUnreachableError: the service was away for too long.
    """
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


def wait_for_task(api: Api, task: dict[str, Any]) -> dict[str, Any]:
    """Return a task when it has succeeded.

    Raises:
        ServiceError: it failed; as if the request that began it had been answered so.
        ServiceUnreachableError: the service was away for too long.
    """
    address, pause = f"/v1/datasets/{task['dataset_id']}/tasks/{task['id']}", _FIRST_PAUSE_SECONDS
    while task["state"] in ("queued", "running"):
        time.sleep(pause)
        pause = min(1.5 * pause, _LAST_PAUSE_SECONDS)
        task = api.get(address)
    if (problem := task["problem"]) is not None:
        raise problem_error(problem, problem["status"])
    return task


def commit(api: Api, dataset: dict[str, Any]) -> dict[str, Any]:
    """Commit a dataset, however long its check takes; returns it.

    Raises:
        ServiceError: the service refuses it; the text names the files.
    """
    address, patience = f"/v1/datasets/{dataset['id']}", Backoff(MAX_CHECK_WAIT_SECONDS)
    while dataset["state"] != "committed":
        try:
            response = api.post_response(f"{address}/commit")
        except ServiceError as error:
            # 409: a front end of the former version is checking the dataset.
            if error.status != 409:
                raise
            dataset = api.get(address)
            if dataset["state"] != "committed" and not patience.wait():
                raise
        else:
            if response.status_code == httpx.codes.ACCEPTED:
                wait_for_task(api, response.json())
                dataset = api.get(address)
            else:
                dataset = response.json()
    return dataset


def fill_and_commit(api: Api, dataset: dict[str, Any], fill: Callable[[], object]) -> dict[str, Any]:
    """Fill a dataset if it is open, and commit it; returns it.

    It was made for just these files, so that whoever sends the same at once and closes it has sent all.

    Args:
        api: the service.
        dataset: from :func:`create_dataset_once`.
        fill: sends what is lacking.

    Raises:
        ServiceError: the service refuses the files or the dataset.
    """
    if dataset["state"] == "open":
        try:
            fill()
        except ServiceError as error:
            # 409: it takes no files any more. 404: an upload is over, as its file is stored.
            if error.status not in (httpx.codes.NOT_FOUND, httpx.codes.CONFLICT):
                raise
            dataset = api.get(f"/v1/datasets/{dataset['id']}")
            if dataset["state"] == "open":
                raise
    return commit(api, dataset)


def is_web_address(scene: object) -> bool:
    """Return whether a scene is named by an address that the service can fetch it from."""
    return isinstance(scene, str) and scene.startswith(("https://", "http://"))


def import_dataset(
    api: Api, url: str, *, name: str | None = None, sha256: str | None = None, version: str | None = None
) -> dict[str, Any]:
    """Let the service fetch a scene, a ZIP file, and commit it.

    Args:
        api: the service.
        url: where the ZIP file is; https, and reachable from everywhere.
        name: what to call the dataset; by default as the file.
        sha256: what the ZIP file must be; then the same call again makes no second dataset.
        version: what names the ZIP file and its content where the address does not; then as with a digest.

    Returns:
        The dataset.

    Raises:
        ServiceError: the address does not answer well, or the scene is refused.
    """
    name = name or PurePosixPath(urlsplit(url).path).stem
    if version is None and sha256 is not None:
        version = url
    key = (
        uuid.uuid4().hex
        if version is None
        else hashlib.sha256(f"{version}\n{sha256}\n{name}".encode()).hexdigest()
    )
    dataset = create_dataset_once(api, {"name": name[:200]}, f"import-{key}")
    body = {"url": url, "sha256": sha256}
    return fill_and_commit(
        api, dataset, lambda: wait_for_task(api, api.post(f"/v1/datasets/{dataset['id']}/import", body))
    )
