"""``simplify``: a scene with fewer Gaussians."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import Field

from octasplat.engine.core.errors import DiskFullError
from octasplat.engine.core.events import EventListener, PhaseProgress, ignore_events
from octasplat.engine.core.progress import phase
from octasplat.engine.operations.base import (
    Operation,
    Options,
    SceneRequest,
    ScenesWritten,
    never_stop,
    options_of,
    stop_if,
)
from octasplat.engine.settings.fields import Spelling, Unit


class SimplifyOptions(Options):
    """Options of how many Gaussians to leave."""

    count: Annotated[int, Spelling(("-n", "--count"), metavar="N"), Unit("Gaussians")] = Field(
        ge=1, description="Number of Gaussians to leave; a scene that has no more stays as it is."
    )


class SimplifyRequest(SimplifyOptions, SceneRequest):
    """Merge neighboring Gaussians of like color and orientation until so many are left.

    For viewers and devices that cannot show all of them: half of the Gaussians look nearly like all.
    """


class SimplifyResult(ScenesWritten):
    """The simplified scene.

    Attributes:
        kept: number of Gaussians that are left.
        count: number of Gaussians of the source.
    """

    kept: int
    count: int


def run(
    request: SimplifyRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> SimplifyResult:
    """Simplify a scene; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        SceneFileError: the scene cannot be read or written.
    """
    from octasplat.engine.gaussians.simplification import simplify
    from octasplat.engine.operations import scene_io

    source: Path = request.source
    scene_io.check_edited_output("simplify", request, request.output)
    # where the result is to be written there is room for a large scene, too
    folder = request.output.parent if request.output.parent.is_dir() else None
    gaussians = scene_io.open_scene(source, progress, folder=folder)
    count, excess = len(gaussians), len(gaussians) - request.count

    def on_round(left: int) -> None:
        stop_if(should_stop)
        progress(PhaseProgress("simplify", count - left, excess))

    stop_if(should_stop)
    with phase("simplify", progress, max(excess, 0)):
        try:
            simplified = simplify(gaussians, request.count, on_round, folder)
        except DiskFullError:
            # files spare memory, and the result may be much smaller than what is on the way
            simplified = simplify(gaussians, request.count, on_round)
    stop_if(should_stop)
    record = scene_io.describe_edit(
        "simplify", options_of(SimplifyOptions, request), gaussians=len(simplified)
    )
    written = scene_io.write_edited_scene(source, simplified, request.output, progress, edit_record=record)
    notes = (f"{source}: {count:,} Gaussians became {len(simplified):,}.", written.sentence)
    return SimplifyResult(
        files=written.files, folder=written.folder, notes=notes, kept=len(simplified), count=count
    )


OPERATION = Operation(
    "simplify", "Merge neighbors until so many Gaussians are left.", SimplifyRequest, SimplifyOptions, run
)
