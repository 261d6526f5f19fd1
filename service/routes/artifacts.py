"""Results of jobs, and pictures of scenes in the making."""

import asyncio
import uuid
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response

from service.auth import Reader
from service.downloads import send_blob
from service.problems import not_found
from service.routes import problems
from service.routes.jobs import owned_job, read_job
from service.schemas.artifacts import ArtifactList, ArtifactView
from service.state import ServiceDep
from workers.queue.jobs import artifacts_of, get_artifact

router = APIRouter(prefix="/v1/jobs", tags=["results"])


@router.get("/{job_id}/artifacts", responses=problems(404))
async def list_artifacts(job_id: uuid.UUID, who: Reader, service: ServiceDep) -> ArtifactList:
    """The results of a job; none before it has succeeded."""
    async with service.pool.connection() as connection:
        await owned_job(connection, who, job_id)
        found = await artifacts_of(connection, job_id)
    return ArtifactList(artifacts=[ArtifactView.of(row) for row in found])


@router.get("/{job_id}/artifacts/{name:path}", responses=problems(404, 410, 416), response_class=Response)
@router.head("/{job_id}/artifacts/{name:path}", responses=problems(404, 410, 416), include_in_schema=False)
async def get_artifact_content(
    job_id: uuid.UUID, name: Annotated[str, Path(max_length=1000)], who: Reader, service: ServiceDep,
    request: Request,
    inline: Annotated[bool, Query(description="Show it in the browser rather than save it.")] = False,
) -> Response:  # fmt: skip
    """A result; `Range` and `If-Range` let a download go on."""
    async with service.pool.connection() as connection:
        await owned_job(connection, who, job_id)
        row = await get_artifact(connection, job_id, name) if "\0" not in name else None
    if row is None:
        raise not_found("result")
    return await asyncio.to_thread(
        lambda: send_blob(
            service,
            request,
            sha256=row.sha256,
            size_bytes=row.size_bytes,
            media_type=row.media_type,
            name=row.name,
            inline=inline,
        )
    )


@router.get(
    "/{job_id}/preview",
    responses={200: {"content": {"image/png": {}}}, **problems(404, 410)},
    response_class=Response,
)
async def get_preview(job_id: uuid.UUID, who: Reader, service: ServiceDep, request: Request) -> Response:
    """The newest picture of the scene in the making."""
    job = await read_job(service, who, job_id)
    if job.preview is None:
        raise not_found("picture yet")
    sha256: str = job.preview["sha256"]
    response = await asyncio.to_thread(
        lambda: send_blob(
            service,
            request,
            sha256=sha256,
            size_bytes=service.storage.stat(sha256).size_bytes,
            media_type="image/png",
            name="preview.png",
        )
    )
    response.headers["Cache-Control"] = "no-cache"
    return response
