"""``stage init``: a first stage of a scene, to be edited."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from pydantic import Field

from octasplat.engine.core.errors import OutputError
from octasplat.engine.core.events import EventListener, Noted, Warned, ignore_events
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.operations.axes import Axis, axis_named
from octasplat.engine.operations.base import Operation, Options, Result, WritingRequest, never_stop, stop_if
from octasplat.engine.operations.render_options import UP_OF_RUN_UNUSED, Point
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import DatasetFolder, Output, Source

UNKNOWN_UP = "A file does not say what is up, so that -y was taken; --up names another axis, such as z."


class StageInitOptions(Options):
    """Options of an initial stage file besides the scene that it fits."""

    up: Axis | None = Field(
        None, description="The axis of a file that points up; a run knows its own.  [default: -y]"
    )


class StageInitRequest(StageInitOptions, WritingRequest):
    """Write a stage that fits a scene, the folder of a run or a file of Gaussians, to be edited.

    It knows what is up, has a ball on what seems to be the floor, and a light from where the scene's own
    seems to come; a run with materials is shown with them, in the light that it has learnt. What else there
    is stands in it as comments.
    """

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.DATASET

    source: Source = Field(description="The scene: the folder of a run, or a file of any format.")
    output: Output = Field(description="The TOML file to write.")
    dataset: DatasetFolder = Field(
        None,
        description="Take the cameras of the photographs in this folder.  [default: those that the run "
        "keeps]",
    )
    copy_light: bool = Field(
        False, description="Put the map of light that the stage names beside it, so that both can be moved."
    )


class StageInitResult(Result):
    """The stage that was written.

    Attributes:
        up: the direction in the world that is up in it.
        has_floor: whether the scene shows a floor, on which the ball stands.
    """

    up: Point
    has_floor: bool

    def lines(self) -> tuple[str, ...]:
        """Return a sentence with the stage's place and up direction."""
        return (f"Wrote {self.files[0]}; up is {' '.join(f'{x:.3g}' for x in self.up)}.",)


def run(
    request: StageInitRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> StageInitResult:
    """Write a first stage; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        OutputError: there is such a file already, or it cannot be written.
        OctasplatError: the scene cannot be read.
    """
    from octasplat.engine.operations.render_source import open_stage_scene
    from octasplat.engine.operations.stage_light import first_stage_light, run_around
    from octasplat.engine.operations.written_files import check_targets
    from octasplat.engine.pathtracing.stage.stage_template import write_stage_template
    from octasplat.engine.pathtracing.stage_scene import first_stage_layout
    from octasplat.engine.runs.run_folder import VIEWS

    output: Path = request.output
    check_targets("stage-init", [output], [request.source, request.dataset], overwrite=request.overwrite)
    source, run_folder = request.source, run_around(request.source)
    is_file_of_run = run_folder is not None and run_folder != source and (run_folder / VIEWS).exists()
    if run_folder is not None and is_file_of_run and request.up is None:
        progress(Noted(f"{source} is the scene of the run {run_folder}, which says what is up."))
        source = run_folder
    scene = open_stage_scene(source, progress, dataset=request.dataset, threads=threads)
    if request.up is not None and scene.photographs is not None:
        progress(Warned(UP_OF_RUN_UNUSED))
    facts = first_stage_layout(scene, None if request.up is None else axis_named(request.up))
    if request.up is None and scene.photographs is None:
        progress(Noted(f"{source}: {UNKNOWN_UP}"))
        facts = replace(facts, note="\n".join(filter(None, (facts.note, UNKNOWN_UP))))
    light = first_stage_light(source, scene.gaussians, output.parent, lambda text: progress(Noted(text)))
    stop_if(should_stop)
    files = [output]
    try:
        if request.copy_light and light.environment is not None:
            original, beside = output.parent / light.environment, output.parent / Path(light.environment).name
            if beside.resolve() != original.resolve():
                if run_around(output.parent) is not None:
                    raise OutputError(
                        f"The light of {source} would take the place of that of the run {output.parent}; "
                        "write the stage into another folder, or leave out --copy-light."
                    )
                check_targets("stage-init", [beside], [request.source], overwrite=request.overwrite)
                with atomic_replace(beside) as partial:
                    shutil.copyfile(original, partial)
                files.append(beside)
            light = replace(light, environment=beside.name)
        write_stage_template(output, facts, light)
    except OSError as error:
        raise OutputError(f"Cannot write {output}: {error.strerror or error}.") from error
    return StageInitResult(files=tuple(files), up=facts.up, has_floor=facts.has_floor)


OPERATION = Operation(
    "stage-init", "Write a commented stage that fits a scene.", StageInitRequest, StageInitOptions, run
)
