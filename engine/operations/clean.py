"""``clean``: remove Gaussians that disturb the scene."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.edit.edit_options import CleanupOptions
from octasplat.engine.edit.reports import CleanReport
from octasplat.engine.operations.base import (
    CHANGED_SCENE,
    Operation,
    Options,
    ScenesWritten,
    SourceRequest,
    emit_warning,
    never_stop,
    options_of,
    stop_if,
)
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import OUTPUT_FLAGS, Spelling, Unit


class CleanOptions(CleanupOptions, Options):
    """Options of which Gaussians to remove: faint, too small or large, isolated, unseen or near a camera."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.CLEAN

    camera_clearance: Annotated[float, Spelling(metavar="SHARE")] = Field(
        0.25,
        ge=0.0,
        lt=1.0,
        description="In a run: remove those nearer to the camera of a training view than this share of the "
        "distance at which the sparse points around it begin; 0 for none.",
    )
    min_views: Annotated[int, Unit("views")] = Field(
        0,
        ge=0,
        description="In a run: remove those whose centre lies in the image of fewer training views than "
        "this, which lie beyond what the cameras see; 0 for none.",
    )


class CleanRequest(CleanOptions, SourceRequest):
    """Remove Gaussians that cannot be seen, are too large, near to a camera or out of all views, or float.

    ``octasplat info`` tells how large and how opaque they are.
    """

    output: Annotated[Path | None, OUTPUT_FLAGS] = Field(None, description=CHANGED_SCENE)
    dry_run: bool = Field(False, description="Only count.")

    @model_validator(mode="after")
    def _writes_or_counts(self) -> "CleanRequest":
        if (self.output is None) != self.dry_run:
            raise ValueError("Name the result with `output`, or say `dry_run`")
        return self


class CleanResult(CleanReport, ScenesWritten):
    """Counts of the removed Gaussians, each by the first reason that holds.

    Attributes:
        count: number of Gaussians of the source.
    """

    count: int


def run(
    request: CleanRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> CleanResult:
    """Remove disturbing Gaussians; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        ConfigError: nothing would be left.
        SceneFileError: the scene cannot be read or written.
    """
    from octasplat.engine.edit.cleaning import clean
    from octasplat.engine.operations import scene_io
    from octasplat.engine.runs.run_folder import is_run, run_camera_clearance, run_seen_test

    source: Path = request.source
    if request.output is not None:
        scene_io.check_edited_output("clean", request, request.output)
    gaussians = scene_io.open_scene(source, progress)
    if not is_run(source):  # a file has neither cameras nor sparse points
        for name in ("camera_clearance", "min_views"):
            if getattr(request, name) not in (0, CleanOptions.model_fields[name].default):
                emit_warning(progress, f"{source}: {name} goes with the folder of a run and is passed over.")
    share = request.camera_clearance
    zones = run_camera_clearance(source, share) if share > 0 and is_run(source) else None
    seen = run_seen_test(source, request.min_views) if request.min_views > 0 and is_run(source) else None
    keep, report = clean(gaussians, request, zones, seen)
    message = (
        f"{source}: {len(gaussians):,} Gaussians; {report.faint:,} too faint, {report.small:,} too small, "
        f"{report.large:,} too large, {report.near:,} too near to a camera, "
        f"{report.unseen:,} beyond what the cameras see, "
        f"{report.floating:,} in {report.groups:,} groups of floaters; {report.kept:,} kept."
    )
    if not keep.any():
        raise ConfigError(
            f"{source}: nothing of it would be left; ask for less (octasplat info tells its sizes and "
            "opacities)."
        )
    counts = {"count": len(gaussians), **report.model_dump()}
    if request.output is None:
        return CleanResult(notes=(message,), **counts)  # all but the file's writing is done, as in a real run
    stop_if(should_stop)
    record = scene_io.describe_edit("clean", options_of(CleanOptions, request), gaussians=report.kept)
    written = scene_io.write_edited_scene(
        source, gaussians.select(keep), request.output, progress, edit_record=record
    )
    return CleanResult(
        files=written.files, folder=written.folder, notes=(message, written.sentence), **counts
    )


OPERATION = Operation(
    "clean", "Remove faint Gaussians, oversized ones and floaters.", CleanRequest, CleanOptions, run
)
