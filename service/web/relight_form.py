"""Data of the relighting form: the views of a finished job with materials, and environment maps."""

import uuid
from collections.abc import Sequence
from dataclasses import dataclass

from octasplat.service.actions.datasets import list_files_by_suffix
from octasplat.service.auth import Principal
from octasplat.service.settings import ServiceSettings
from octasplat.service.state import Service
from octasplat.service.web.results import LEARNT_LIGHT
from octasplat.service.web.stage_form import MAX_VIEWS, PREVIEW_PRIORITY
from octasplat.workers.db.rows import Artifact
from octasplat.workers.worker.job_kinds import get_job_kind

ENVIRONMENT_SUFFIXES = (".hdr", ".exr")
MAX_ENVIRONMENTS = 60


@dataclass(frozen=True)
class UploadedEnvironment:
    """An uploaded environment map: its dataset, the dataset's name, and its name in it."""

    dataset_id: uuid.UUID
    title: str
    name: str


@dataclass(frozen=True)
class RelightForm:
    """The relighting form.

    Attributes:
        views: names of the photographs that were held out, for previews.
        maps: that are here already, the newest first.
        learnt: name of the result that shows the light which the job learnt.
        priority: of a preview.
        max_file_bytes: length of one file that is sent.
    """

    views: list[str]
    maps: list[UploadedEnvironment]
    learnt: str | None
    priority: int
    max_file_bytes: int


async def relight_form(
    service: Service, principal: Principal, artifacts: Sequence[Artifact], held_out: Sequence[str]
) -> RelightForm | None:
    """Return the form for a job's result; None without materials, or if the caller may not queue jobs."""
    names = {row.name for row in artifacts}
    if not principal.may("write") or not names.issuperset(get_job_kind("relight").source_files):
        return None
    files = await list_files_by_suffix(service, principal, ENVIRONMENT_SUFFIXES, limit=MAX_ENVIRONMENTS)
    settings: ServiceSettings = service.settings
    return RelightForm(
        sorted(held_out)[:MAX_VIEWS],
        [UploadedEnvironment(dataset.id, dataset.name, path) for dataset, path in files],
        LEARNT_LIGHT if LEARNT_LIGHT in names else None,
        min(PREVIEW_PRIORITY, settings.max_priority),
        settings.max_upload_bytes,
    )
