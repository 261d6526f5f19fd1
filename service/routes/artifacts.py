"""Routes of job results, and previews of running jobs."""

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response

from octasplat.service.actions import artifacts as actions
from octasplat.service.auth import Reader
from octasplat.service.downloads import send_archive, send_blob, send_bytes
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import IfNoneMatch, IfRange, JobId, Range
from octasplat.service.routes.response_headers import DISPOSITION, stored_content, with_headers
from octasplat.service.schemas.artifacts import ArtifactList, ArtifactView
from octasplat.service.state import ServiceDep

router = APIRouter(prefix="/v1/jobs", tags=["results"])

PreviewStep = Annotated[
    int | None,
    Query(
        alias="step", description="Changes nothing: gives each picture an address of its own in a browser."
    ),
]
ArtifactName = Annotated[str, Path(max_length=1000, description="Such as scene.ply or renders/view_000.png.")]


@router.get("/{job_id}/artifacts", responses=problem_responses(404))
async def list_artifacts(job_id: JobId, principal: Reader, service: ServiceDep) -> ArtifactList:
    """Return the results of a job; none before it has succeeded."""
    found = await actions.list_artifacts(service, principal, job_id)
    return ArtifactList(artifacts=[ArtifactView.from_row(row) for row in found])


@router.get(
    "/{job_id}/artifacts/{name:path}",
    responses={**stored_content(), **problem_responses(404, 410, 416)},
    response_class=Response,
)
@router.head(
    "/{job_id}/artifacts/{name:path}", responses=problem_responses(404, 410, 416), include_in_schema=False
)
async def get_artifact_content(
    job_id: JobId, name: ArtifactName, principal: Reader, service: ServiceDep,
    request: Request,
    inline: Annotated[bool, Query(description="Show it in the browser rather than save it.")] = False,
    _range: Range = None, _if_range: IfRange = None, _if_none_match: IfNoneMatch = None,
) -> Response:  # fmt: skip
    """Return a result; `Range` and `If-Range` let a download resume."""
    row = await actions.get_artifact(service, principal, job_id, name)
    return await send_blob(
        service, request, row.sha256, row.size_bytes, media_type=row.media_type, name=row.name, inline=inline
    )


@router.get(
    "/{job_id}/archive",
    responses={
        **with_headers(
            200,
            DISPOSITION,
            description="The ZIP file",
            content={"application/zip": {"schema": {"type": "string", "format": "binary"}}},
        ),
        **problem_responses(404, 410),
    },
    response_class=Response,
)
async def get_results_archive(job_id: JobId, principal: Reader, service: ServiceDep) -> Response:
    """Return all results as one ZIP file, which is made while it is sent.

    Its length is not known before and it cannot be resumed; single results can.
    """
    job, found = await actions.get_job_with_artifacts(service, principal, job_id)
    name = f"octasplat-{job.id.hex[-12:]}.zip"
    return send_archive(service, found, name, job.finished_at or job.created_at)


@router.get(
    "/{job_id}/preview",
    responses={**stored_content("image/png", "multipart/byteranges"), **problem_responses(404, 410, 416)},
    response_class=Response,
)
async def get_preview(
    job_id: JobId, principal: Reader, service: ServiceDep, request: Request,
    _step: PreviewStep = None, _range: Range = None, _if_none_match: IfNoneMatch = None,
) -> Response:  # fmt: skip
    """Return the newest preview of a running job."""
    blob = await actions.get_preview(service, principal, job_id)
    response = await send_blob(
        service, request, blob.sha256, blob.size_bytes, media_type="image/png", name="preview.png"
    )
    response.headers["Cache-Control"] = "no-cache"
    return response


@router.get(
    "/{job_id}/live-scene",
    responses={**stored_content("application/octet-stream"), **problem_responses(404, 410, 416)},
    response_class=Response,
)
async def get_live_scene(
    job_id: JobId, principal: Reader, service: ServiceDep, request: Request,
    _step: PreviewStep = None, _range: Range = None, _if_none_match: IfNoneMatch = None,
) -> Response:  # fmt: skip
    """Return the newest state of a training as a PLY file, decimated; the sparse points before it begins.

    While blocks are trained it is the coarse scene, with what each block that is done has learnt in its
    place. The event `live_scene` tells of each. There is none any more once the job has succeeded.
    """
    found = await actions.get_live_scene(service, principal, job_id)
    media_type, name = "application/octet-stream", "live_scene.ply"
    if isinstance(found, bytes):
        response = send_bytes(request, found, media_type=media_type, name=name)
    else:
        response = await send_blob(
            service, request, found.sha256, found.size_bytes, media_type=media_type, name=name
        )
    response.headers["Cache-Control"] = "no-cache"
    return response
