"""``crop``: keep part of a scene."""

from collections.abc import Callable
from pathlib import Path

from pydantic import model_validator

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.edit.edit_options import Selection
from octasplat.engine.operations.base import (
    Operation,
    Options,
    SceneRequest,
    ScenesWritten,
    never_stop,
    options_of,
    stop_if,
)


class CropOptions(Selection, Options):
    """Options of which Gaussians to keep: those for which all given conditions hold."""

    @model_validator(mode="after")
    def _check_selection_given(self) -> "CropOptions":
        if self.where is None and self.box is None and self.sphere is None:
            raise ValueError("Say what to keep: a box, a sphere or an expression (where)")
        return self


class CropRequest(CropOptions, SceneRequest):
    """Keep those Gaussians of the scene for which all that is given holds.

    Boxes and spheres ask for centres; ``octasplat info`` tells where they lie.
    """


class CropResult(ScenesWritten):
    """The cropped scene.

    Attributes:
        kept: number of Gaussians that were kept.
        count: number of Gaussians of the source.
    """

    kept: int
    count: int


def run(
    request: CropRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> CropResult:
    """Keep part of a scene; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        ConfigError: nothing would be kept.
        SceneFileError: the scene cannot be read or written.
    """
    from octasplat.engine.core.local_origin import user_position
    from octasplat.engine.edit.selection import selection_mask
    from octasplat.engine.files import read_metadata
    from octasplat.engine.operations import scene_io

    source: Path = request.source
    scene_io.check_edited_output("crop", request, request.output)
    gaussians, origin = scene_io.open_scene(source, progress), read_metadata(source).origin_world
    keep = selection_mask(gaussians, request, origin)
    if not keep.any():
        # the message helps to choose a box: positions in the user's coordinates
        means = gaussians.means_world
        corners = [user_position(corner, origin) for corner in (means.min(axis=0), means.max(axis=0))]
        bounds = " to ".join(corners)
        raise ConfigError(
            f"{source}: nothing of it would be kept; its centres lie in {bounds} (octasplat info tells where "
            "its solid part is)."
        )
    kept, count = int(keep.sum()), len(keep)
    stop_if(should_stop)
    record = scene_io.describe_edit("crop", options_of(CropOptions, request), gaussians=kept)
    written = scene_io.write_edited_scene(
        source, gaussians.select(keep), request.output, progress, edit_record=record
    )
    notes = (f"{source}: {kept:,} of {count:,} Gaussians kept.", written.sentence)
    return CropResult(files=written.files, folder=written.folder, notes=notes, kept=kept, count=count)


OPERATION = Operation("crop", "Keep part of a scene.", CropRequest, CropOptions, run)
