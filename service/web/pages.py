"""Pages: one job with its results, and a new job; and the parts that refresh themselves."""

import json
import urllib.parse
import uuid
from collections.abc import Collection
from dataclasses import replace
from typing import Any, Literal

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, JSONResponse

from octasplat.engine.operations.clean import CleanOptions
from octasplat.engine.settings.preset_names import PRESET_WORDS
from octasplat.service.actions import jobs as actions
from octasplat.service.actions.artifacts import find_live_scene, get_artifact, list_artifacts
from octasplat.service.actions.datasets import list_datasets
from octasplat.service.actions.start_sources import may_be_begun_with
from octasplat.service.actions.submission import retry_job
from octasplat.service.actions.system import list_live_workers
from octasplat.service.auth import Principal, Reader, Writer
from octasplat.service.downloads import send_blob
from octasplat.service.job_limits import limits_by_path
from octasplat.service.queue_workers import unwritable_formats
from octasplat.service.schemas.jobs import JobChange, JobView, RetryRequest
from octasplat.service.state import Service, ServiceDep
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.service.web.form_fields import FormField
from octasplat.service.web.formatting import format_thousands
from octasplat.service.web.forms import KINDS_WITH_OWN_FORM, options_form
from octasplat.service.web.job_cameras import viewer_cameras_of_job
from octasplat.service.web.relight_form import relight_form
from octasplat.service.web.results import (
    CONFIG,
    HELD_OUT,
    LAYERS,
    METRICS,
    REPORT,
    SCENE,
    VIEWS,
    download_groups,
    read_json,
    read_measurements,
    read_names,
    viewable_mesh,
)
from octasplat.service.web.routing import PageRoute, is_htmx_request, redirect
from octasplat.service.web.stage_form import stage_form
from octasplat.service.web.templating import render_page
from octasplat.service.web.view_models import ACTIVE, job_detail, photographs_of
from octasplat.workers.db.live_scenes import ShownScene
from octasplat.workers.db.rows import Artifact
from octasplat.workers.worker.job_kinds import get_job_kind, job_kinds
from octasplat.workers.worker.job_kinds.scene_kinds import LIGHT_FILE

router = APIRouter(route_class=PageRoute, include_in_schema=False)

MAX_DATASETS = 50
MAX_PICTURES = 24
MAX_LABEL = 200
_MAX_LABEL_FORM_BYTES = 4096
# The report brings its script along: it runs, but as nobody, and can reach nothing.
_REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)


@router.get("/jobs/{job_id}")
async def show_job(request: Request, job_id: uuid.UUID, principal: Reader, service: ServiceDep) -> Response:
    """Return the page of a job: its state, and its results once it has some."""
    detail = await job_detail(service, principal, job_id)
    artifacts = await list_artifacts(service, principal, job_id)
    photographs = await photographs_of(service, principal, job_id)
    unwritable = unwritable_formats(await list_live_workers(service))
    by_name = {row.name: row for row in artifacts}
    live = await find_live_scene(service, principal, job_id)
    metrics, config, views = await run_in_pool(
        ThreadPurpose.DOWNLOADS,
        lambda: [read_json(service.storage, by_name.get(name)) for name in (METRICS, CONFIG, VIEWS)],
    )
    held_out = await run_in_pool(ThreadPurpose.DOWNLOADS, read_names, service.storage, by_name.get(HELD_OUT))
    figures = read_measurements(metrics, artifacts, photographs)
    shows_materials = LIGHT_FILE in by_name and _shows_materials(config)
    preview = detail.line.job.preview or {}
    preview_path = f"images/{preview.get('view')}"
    extra = [
        kind
        for kind in job_kinds()
        if kind.needs == "result"
        and kind.name not in KINDS_WITH_OWN_FORM
        and _has_required_file(kind.source_files, by_name)
    ]
    return render_page(
        request,
        "job.html",
        principal,
        detail=detail,
        measured=figures,
        light=stage_form(figures, artifacts, photographs, service.settings, has_learnt_light=shows_materials)
        if principal.may("write")
        else None,
        relight=await relight_form(service, principal, artifacts, held_out),
        layers=LAYERS,
        pictures=[row for row in artifacts if row.name.startswith("views/") and row.name.endswith(".png")][
            :MAX_PICTURES
        ],
        groups=download_groups(artifacts),
        scene=by_name.get(SCENE),
        live=live,
        live_count=_live_count(live) if SCENE not in by_name else "",
        view_notes=[note.model_dump() for note in detail.line.job.view_notes],
        shows_live=detail.line.job.kind == "reconstruct"
        and detail.line.job.state != "succeeded"
        and (live is not None or detail.line.job.state in ACTIVE),
        edit=_edit_values(views) if SCENE in by_name and principal.may("write") else None,
        mesh=viewable_mesh(artifacts),
        report=by_name.get(REPORT),
        video=next((row for row in artifacts if row.media_type == "video/mp4"), None),
        q=_octagon_q(config),
        up=_up_world(config),
        background=_evaluation_background(config),
        shows_materials=shows_materials,
        photograph=preview_path if any(file.path == preview_path for file in photographs) else None,
        further=[options_form(kind, unwritable) for kind in extra] if principal.may("write") else [],
        max_file_bytes=service.settings.max_upload_bytes,
        go_on=_files_field(detail.line.job, unwritable) if principal.may("write") else None,
    )


@router.get("/parts/jobs/{job_id}")
async def show_job_status(
    request: Request, job_id: uuid.UUID, principal: Reader, service: ServiceDep
) -> Response:
    """Return the state of a job without its page."""
    return render_page(
        request, "_status.html", principal, detail=await job_detail(service, principal, job_id)
    )


@router.get("/jobs/{job_id}/report")
async def show_report(
    request: Request, job_id: uuid.UUID, principal: Reader, service: ServiceDep
) -> Response:
    """Return the report of a job as a page."""
    row = await get_artifact(service, principal, job_id, REPORT, kind="report")
    response = await send_blob(
        service, request, row.sha256, row.size_bytes, media_type="text/html", name=REPORT, inline=True
    )
    # In the place of that of send_blob, under which no script runs.
    response.headers["Content-Security-Policy"] = _REPORT_POLICY
    return response


@router.get("/jobs/{job_id}/cameras.json")
async def get_cameras(job_id: uuid.UUID, principal: Reader, service: ServiceDep) -> JSONResponse:
    """Return the cameras of a job's photographs, for the viewer."""
    artifacts = await list_artifacts(service, principal, job_id)
    files = await photographs_of(service, principal, job_id)
    held_out = next((row for row in artifacts if row.name == HELD_OUT), None)
    shown = await find_live_scene(service, principal, job_id)
    live = None if shown is None else shown.scene
    content = await run_in_pool(
        ThreadPurpose.DOWNLOADS, viewer_cameras_of_job, service, artifacts, files, held_out, live
    )
    headers = {"Cache-Control": "private, max-age=300" if live is None else "no-cache"}
    return JSONResponse(content, headers=headers)


@router.get("/new")
async def show_new(
    request: Request,
    principal: Writer,
    service: ServiceDep,
    dataset: uuid.UUID | None = None,
    like: uuid.UUID | None = None,
) -> Response:
    """Return the page that uploads photographs and queues their reconstruction, perhaps like another job."""
    found = None if like is None else await actions.get_job(service, principal, like)
    earlier = None if found is None else found.view
    kind = get_job_kind("reconstruct")
    datasets = await list_datasets(service, principal, limit=MAX_DATASETS)
    workers = await list_live_workers(service)
    return render_page(
        request,
        "new.html",
        principal,
        form=options_form(kind, unwritable_formats(workers), limits_by_path(kind, service.settings)),
        presets=PRESET_WORDS,
        from_files=[options_form(other) for other in job_kinds() if other.needs == "files"],
        datasets=[row for row in datasets.rows if row.state == "committed" and row.holds == "photographs"],
        chosen=dataset or (earlier.dataset_id if earlier else None),
        earlier=earlier,
        may_begin_with=found is not None and await may_be_begun_with(service, kind, found.row),
        queues=sorted(
            {"cpu", *([earlier.queue] if earlier else ()), *(q for worker in workers for q in worker.queues)}
            - {""}
        ),
        max_file_bytes=service.settings.max_upload_bytes,
    )


@router.post("/jobs/{job_id}/cancel")
async def cancel(request: Request, job_id: uuid.UUID, principal: Writer, service: ServiceDep) -> Response:
    """Cancel a job and return its updated page."""
    await actions.cancel_job(service, principal, job_id)
    return await _updated_page(request, job_id, principal, service)


@router.post("/jobs/{job_id}/retry")
async def retry(
    request: Request, job_id: uuid.UUID, principal: Writer, service: ServiceDep,
    start: Literal["checkpoint", "start"] = "checkpoint",
) -> Response:  # fmt: skip
    """Queue a job again and return its updated page."""
    await retry_job(service, principal, job_id, RetryRequest(start=start))
    return await _updated_page(request, job_id, principal, service)


@router.post("/jobs/{job_id}/pin")
async def pin(
    request: Request, job_id: uuid.UUID, principal: Writer, service: ServiceDep, keep: bool = True
) -> Response:
    """Pin a job so that it does not expire, or unpin it."""
    await actions.change_job(service, principal, job_id, JobChange(pinned=keep))
    return await _updated_page(request, job_id, principal, service)


@router.post("/jobs/{job_id}/label")
async def rename(request: Request, job_id: uuid.UUID, principal: Writer, service: ServiceDep) -> Response:
    """Give a job another name, or with an empty one that of its dataset, and return to it."""
    body = (await request.body())[:_MAX_LABEL_FORM_BYTES].decode(errors="replace")
    label = urllib.parse.parse_qs(body).get("label", [""])[0].strip()
    await actions.change_job(service, principal, job_id, JobChange(label=label[:MAX_LABEL] or None))
    return redirect(request, f"/jobs/{job_id}")


@router.post("/jobs/{job_id}/delete")
async def delete(request: Request, job_id: uuid.UUID, principal: Writer, service: ServiceDep) -> Response:
    """Delete a job with its results and go to the list."""
    await actions.delete_job(service, principal, job_id)
    return redirect(request, "/")


async def _updated_page(
    request: Request, job_id: uuid.UUID, principal: Principal, service: Service
) -> Response:
    """Return the changed parts of the page that sent the request."""
    if not is_htmx_request(request):
        return redirect(request, f"/jobs/{job_id}")
    # The list loads itself anew at the event, so that nothing is replaced here.
    if request.query_params.get("in") == "list":
        return Response(status_code=200, headers={"HX-Reswap": "none", "HX-Trigger": "jobs-changed"})
    detail = await job_detail(service, principal, job_id)
    response: HTMLResponse = render_page(request, "_status.html", principal, detail=detail)
    response.headers["HX-Trigger"] = json.dumps({"job-changed": {"state": detail.line.job.state}})
    return response


def _has_required_file(source_files: tuple[str, ...], names: dict[str, Artifact]) -> bool:
    return not source_files or source_files[0] in names


def _config_value(config: dict[str, object], *keys: str) -> object:
    found: object = config
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    return found


def _up_world(config: dict[str, object]) -> str:
    """Return the up axis of the light of a result, as JSON."""
    found = _config_value(config, "reconstruction", "train", "materials", "up_world")
    known = isinstance(found, list) and len(found) == 3 and all(isinstance(x, int | float) for x in found)
    return json.dumps(found if known else [0, 0, 1])


def _shows_materials(config: dict[str, object]) -> bool:
    """Return whether the 3D view and stages show the materials of a result, as ``octasplat view`` decides it.

    Where base colors hold the light of a room, light from far away cannot show them; nor what is matt, where
    it has its color from the harmonics.
    """
    recipe = _config_value(config, "reconstruction", "train", "materials", "recipe")
    return (
        bool(_config_value(config, "reconstruction", "train", "materials", "learn"))
        and recipe in (None, "split_sum")  # ref_gaussian has a former name, too
    )


def _evaluation_background(config: dict[str, object]) -> object:
    found = _config_value(config, "reconstruction", "evaluation_background")
    # The second name is that of the version before.
    return found or _config_value(config, "reconstruction", "evaluate_background") or "black"


def _files_field(job: JobView, unwritable: Collection[str]) -> FormField | None:
    """Return the field of the files that a stopped reconstruction writes, as it would now; else None."""
    if job.kind != "reconstruct" or job.state not in ("failed", "canceled"):
        return None
    form = options_form(get_job_kind(job.kind), unwritable)
    field = next(field for field in form.first if field.control == "files")
    return replace(field, default=", ".join(job.options.get("exports") or ()))


def _live_count(live: ShownScene | None) -> str:
    """Return what the viewer says of the state that it shows; job.js says the same of later ones."""
    if live is None:
        return ""
    number = format_thousands(live.gaussians)
    return (
        f"Step {format_thousands(live.step)}, {number} Gaussians" if live.step else f"{number} sparse points"
    )


def _edit_values(views: dict[str, Any]) -> dict[str, object]:
    """Return what the form of crop and clean begins with: the scene's local origin, and the usual options."""
    found = views.get("origin_world")
    known = isinstance(found, list) and len(found) == 3 and all(isinstance(x, int | float) for x in found)
    return {"origin": found if known else [0, 0, 0], "clean": CleanOptions().model_dump(mode="json")}


def _octagon_q(config: dict[str, object]) -> float | None:
    found = _config_value(config, "reconstruction", "train", "trace", "q")
    return float(found) if isinstance(found, int | float) and found > 0 else None
