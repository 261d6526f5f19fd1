"""What would be taken of a scene, by the names and sizes of its files, before it is sent."""

from typing import Annotated

from fastapi import APIRouter, Body, Query

from octasplat.service.auth import Writer
from octasplat.service.intake.scene_preview import (
    ArchiveEndTooShortError,
    ListedFile,
    ScenePreview,
    preview_archive,
    preview_files,
)
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import IdempotencyKey
from octasplat.service.schemas.scene_previews import NewScenePreview, ScenePreviewView
from octasplat.service.state import ServiceDep
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool

PREFIX = "/v1/scene-previews"
MAX_BODY_BYTES = 32 << 20
"""Length of a list of files, or of the end of an archive."""

router = APIRouter(prefix=PREFIX, tags=["datasets"])


@router.post("", responses=problem_responses(413))
async def preview_scene(
    new: NewScenePreview, _principal: Writer, service: ServiceDep, _key: IdempotencyKey = None
) -> ScenePreviewView:
    """Say what of a folder would be taken, left out or refused, with the sentences to show."""
    listed = [ListedFile(file.path, file.size_bytes) for file in new.files]
    limits = service.settings.upload_limits()
    return ScenePreviewView.from_preview(
        await run_in_pool(ThreadPurpose.UNPACKING, preview_files, listed, limits)
    )


@router.post("/archive", responses=problem_responses(413))
async def preview_scene_archive(
    end: Annotated[bytes, Body(media_type="application/octet-stream", description="Its last bytes.")],
    size_bytes: Annotated[int, Query(ge=1, description="Length of the whole archive.")],
    _principal: Writer,
    service: ServiceDep,
    _key: IdempotencyKey = None,
) -> ScenePreviewView:
    """Say the same of a ZIP file; its last bytes, which hold its list of contents, are enough."""
    try:
        preview = await run_in_pool(
            ThreadPurpose.UNPACKING,
            preview_archive,
            end[-size_bytes:],
            size_bytes,
            service.settings.upload_limits(),
        )
    except ArchiveEndTooShortError as error:
        return ScenePreviewView.from_preview(ScenePreview(), needed_bytes=error.needed_bytes)
    return ScenePreviewView.from_preview(preview)
