"""Data of the stage form: images of a finished job in which meshes are placed, and limits."""

from collections.abc import Sequence
from dataclasses import dataclass

from octasplat.service.settings import ServiceSettings
from octasplat.service.web.results import CONFIG, HELD_OUT, SCENE, Measurements
from octasplat.workers.db.rows import Artifact, DatasetFile

REQUIRED_RESULTS = (SCENE, CONFIG, HELD_OUT, "views.json")
MAX_VIEWS = 60
PREVIEW_PRIORITY = 10


@dataclass(frozen=True)
class PlacementView:
    """A held-out view in which meshes can be placed.

    Attributes:
        name: of the photograph.
        render: name of the result that shows it.
        width: of the photograph at its full size, px.
        height: of the photograph at its full size, px.
    """

    name: str
    render: str
    width: int
    height: int


@dataclass(frozen=True)
class StageForm:
    """The form of a stage.

    Attributes:
        views: where things can be placed.
        priority: of a preview.
        max_file_bytes: length of one file that is sent.
        has_learnt_light: whether the scene has materials and the light that they were learnt in, with which
            the form begins.
    """

    views: list[PlacementView]
    priority: int
    max_file_bytes: int
    has_learnt_light: bool


def stage_form(
    measured: Measurements | None,
    artifacts: Sequence[Artifact],
    photographs: Sequence[DatasetFile],
    settings: ServiceSettings,
    *,
    has_learnt_light: bool,
) -> StageForm | None:
    """Return the form for a job's result; None where it has no scene or no image to place meshes in.

    Args:
        measured: measures of the held-out views.
        artifacts: of the job.
        photographs: that it was made from, with their sizes.
        settings: limits of the service.
        has_learnt_light: see :class:`StageForm`.
    """
    names = {row.name for row in artifacts}
    if measured is None or not names.issuperset(REQUIRED_RESULTS):
        return None
    facts = {file.path.removeprefix("images/"): file.facts for file in photographs}
    views = [
        PlacementView(view.name, view.render, int(found["width_px"]), int(found["height_px"]))
        for view in sorted(measured.views, key=lambda view: view.name)
        if view.render is not None and (found := facts.get(view.name)) and found.get("height_px")
    ]
    if not views:
        return None
    priority = min(PREVIEW_PRIORITY, settings.max_priority)
    return StageForm(views[:MAX_VIEWS], priority, settings.max_upload_bytes, has_learnt_light)
