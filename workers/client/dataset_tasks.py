"""Tasks of the service on datasets, waited for: commits, and files that it fetches from an address."""

import time
from typing import Any

from octasplat.workers.client.api import Api, problem_error

_FIRST_PAUSE_SECONDS, _LAST_PAUSE_SECONDS = 0.2, 3.0


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
