"""Routes of work on datasets that lasts longer than a request: begun, and asked for its state."""

import uuid
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response
from fastapi.responses import JSONResponse

from octasplat.service.actions import commits, dataset_tasks, imports
from octasplat.service.actions.datasets import get_dataset
from octasplat.service.auth import Reader, Writer
from octasplat.service.paging import Cursor, Limit, decode_id_cursor, set_next_link
from octasplat.service.problems import ProblemError
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import DatasetId, IdempotencyKey
from octasplat.service.routes.preferences import Prefer, seconds_to_wait
from octasplat.service.routes.response_headers import LINK, LOCATION, RETRY_AFTER, with_headers
from octasplat.service.schemas.dataset_tasks import TaskPage, TaskView
from octasplat.service.schemas.datasets import DatasetView, NewImport
from octasplat.service.state import ServiceDep
from octasplat.workers.db.dataset_tasks import DatasetTask

router = APIRouter(prefix="/v1/datasets", tags=["datasets"])

_LOOK_AGAIN_SECONDS = 1
_ACCEPTED = with_headers(
    202, LOCATION, RETRY_AFTER, model=TaskView, description="It is under way; ask its Location"
)


@router.post("/{dataset_id}/import", status_code=202, responses={**_ACCEPTED, **problem_responses(404, 409)})
async def import_files(
    dataset_id: DatasetId, new: NewImport, principal: Writer, service: ServiceDep, response: Response,
    key: IdempotencyKey = None,
) -> TaskView:  # fmt: skip
    """Fetch a scene as a ZIP file, or one file, from an address; its files are added to those that are there.

    The answer comes at once; the task at its `Location` says when everything is stored.
    """
    task = await imports.request_import(service, principal, dataset_id, new, idempotency_key=key)
    response.headers.update(_task_headers(task))
    return TaskView.from_row(task)


@router.post(
    "/{dataset_id}/commit",
    responses={200: {"description": "It is committed"}, **_ACCEPTED, **problem_responses(404, 409, 410)},
    response_model=DatasetView,
)
async def commit_dataset(
    dataset_id: DatasetId, principal: Writer, service: ServiceDep, prefer: Prefer = None,
    _key: IdempotencyKey = None,
) -> DatasetView | JSONResponse:  # fmt: skip
    """Validate and commit the dataset; it never changes again and jobs can use it. Faults are in `errors`.

    The answer waits some seconds for the end, then it is 202, and the task at its `Location` is to be asked.
    The same request again waits for the same task.
    """
    task = await commits.request_commit(service, principal, dataset_id)
    if task is not None:
        seconds = seconds_to_wait(prefer, service.settings.commit_wait_seconds)
        task = await dataset_tasks.wait_for_task(service, task, seconds)
        if task.problem is not None:
            raise ProblemError.from_document(task.problem)
        if not task.is_over:
            body = TaskView.from_row(task).model_dump(mode="json")
            return JSONResponse(body, status_code=202, headers=_task_headers(task))
    return DatasetView.from_row(await get_dataset(service, principal, dataset_id))


@router.get(
    "/{dataset_id}/tasks/{task_id}", responses={**with_headers(200, RETRY_AFTER), **problem_responses(404)}
)
async def get_task(
    dataset_id: DatasetId,
    task_id: Annotated[uuid.UUID, Path(description="Id of the task.")],
    principal: Reader,
    service: ServiceDep,
    response: Response,
) -> TaskView:
    """Return the state of a commit or an import, which is kept for a week after its end."""
    task = await dataset_tasks.get_task(service, principal, dataset_id, task_id)
    if not task.is_over:
        response.headers["Retry-After"] = str(_LOOK_AGAIN_SECONDS)
    return TaskView.from_row(task)


@router.get("/{dataset_id}/tasks", responses={**with_headers(200, LINK), **problem_responses(404)})
async def list_tasks(
    dataset_id: DatasetId, principal: Reader, service: ServiceDep, request: Request, response: Response,
    limit: Limit = 50, cursor: Cursor = None,
) -> TaskPage:  # fmt: skip
    """List the commits and imports of a dataset, newest first."""
    before = decode_id_cursor(cursor)
    part = await dataset_tasks.list_tasks(service, principal, dataset_id, before=before, limit=limit)
    following = set_next_link(request, response, part.next_key)
    return TaskPage(tasks=[TaskView.from_row(row) for row in part.rows], next=following)


def _task_headers(task: DatasetTask) -> dict[str, str]:
    return {
        "Location": f"/v1/datasets/{task.dataset_id}/tasks/{task.id}",
        "Retry-After": str(_LOOK_AGAIN_SECONDS),
    }
