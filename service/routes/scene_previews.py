"""What would be taken of a scene, by the names and sizes of its files, before it is sent."""

from collections.abc import Callable, Coroutine
from typing import Annotated, Any

from fastapi import APIRouter, Body, Query, Request, Response
from fastapi.responses import StreamingResponse
from fastapi.routing import APIRoute
from pydantic import ValidationError

from octasplat.service.auth import Writer
from octasplat.service.intake.receive import UploadLimits
from octasplat.service.intake.scene_preview import (
    ArchiveEndTooShortError,
    ListedFile,
    ScenePreview,
    preview_archive,
    preview_files,
)
from octasplat.service.json_bounds import parse_in_pieces
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import IdempotencyKey
from octasplat.service.schemas import scene_previews as schemas
from octasplat.service.schemas.scene_previews import MAX_LISTED_FILES, NewScenePreview, ScenePreviewView
from octasplat.service.state import ServiceDep
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool

PREFIX = "/v1/scene-previews"
MAX_BODY_BYTES = 32 << 20
"""Length of a list of files, or of the end of an archive."""
MAX_VALUES = 3 * MAX_LISTED_FILES + 1
"""A file's place in the list, its path and its length."""

_PIECE_BYTES = 1 << 16


class _LargeJsonRequest(Request):
    """A request whose JSON is parsed and validated in a thread, a file of the list after the other."""

    async def json(self) -> Any:
        """Return the parsed body, with those files of the list that are valid as models."""
        return await run_in_pool(ThreadPurpose.BODIES, _read_listing, await self.body())


class _LargeJsonRoute(APIRoute):
    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()

        async def handle_large(request: Request) -> Response:
            return await handle(_LargeJsonRequest(request.scope, request.receive))

        return handle_large


router = APIRouter(prefix=PREFIX, tags=["datasets"], route_class=_LargeJsonRoute)


@router.post("", responses=problem_responses(413), response_model=ScenePreviewView)
async def preview_scene(
    new: NewScenePreview, _principal: Writer, service: ServiceDep, _key: IdempotencyKey = None
) -> Response:
    """Say what of a folder would be taken, left out or refused, with the sentences to show."""
    answer = await run_in_pool(ThreadPurpose.UNPACKING, _preview, new, service.settings.upload_limits())
    # In pieces, so that the answer of a large folder is not compressed in one go.
    pieces = (answer[start : start + _PIECE_BYTES] for start in range(0, len(answer), _PIECE_BYTES))
    return StreamingResponse(pieces, media_type="application/json")


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
            # No more than the whole has, whatever was sent.
            end[-size_bytes:],
            size_bytes,
            service.settings.upload_limits(),
        )
    except ArchiveEndTooShortError as error:
        return ScenePreviewView.from_preview(ScenePreview(), needed_bytes=error.needed_bytes)
    return ScenePreviewView.from_preview(preview)


def _read_listing(body: bytes) -> Any:
    """Return the value of a text of JSON, with those files of the list that are valid as models."""
    value = parse_in_pieces(body)
    if isinstance(value, dict) and isinstance(value.get("files"), list):
        value["files"] = [_as_model(file) for file in value["files"]]
    return value


def _as_model(file: Any) -> Any:
    """Return a file of the list as a model, or as it is where it is none."""
    try:
        return schemas.ListedFile.model_validate(file)
    except ValidationError:
        return file


def _preview(new: NewScenePreview, limits: UploadLimits) -> bytes:
    """Return the answer on a folder as JSON."""
    listed = [ListedFile(file.path, file.size_bytes) for file in new.files]
    return ScenePreviewView.from_preview(preview_files(listed, limits)).model_dump_json().encode()
