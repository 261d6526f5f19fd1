"""``merge``: several scenes as one."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.operations.base import (
    Operation,
    Options,
    SceneRequest,
    ScenesWritten,
    emit_warning,
    never_stop,
    options_of,
    stop_if,
)
from octasplat.engine.settings.fields import AlsoSequence, InputFile, Positional, Source


class MergeOptions(Options):
    """Options of which scenes to merge with the first one."""

    scenes: Annotated[tuple[InputFile, ...], Positional("IN")] = Field(
        (), max_length=100, description="The other scenes: files of any format, each in the same frame."
    )
    sh_degree: int | None = Field(
        None,
        ge=0,
        le=3,
        description="Degree of the colors' harmonics.  [default: the highest among the scenes]",
    )

    @model_validator(mode="after")
    def _are_several(self) -> "MergeOptions":
        if not self.scenes:
            raise ValueError("Name at least two scenes; `scenes` has those to put to the first one")
        return self


class MergeRequest(MergeOptions, SceneRequest):
    """Put all Gaussians of two or more scenes into one file, each where it is in its own frame.

    Named channels that only some of the scenes have are 0 for the Gaussians of the others.
    """

    source: Annotated[Source, AlsoSequence()] = Field(
        description="The first scene: a file of any format, or the folder of a run. Python also takes a "
        "list of all scenes here."
    )

    @model_validator(mode="before")
    @classmethod
    def _first_of_several(cls, given: Any) -> Any:
        """Take a list in the place of the first scene for all scenes, in order."""
        if not isinstance(given, Mapping) or not isinstance(given.get("source"), list | tuple):
            return given
        several, others = given["source"], given.get("scenes") or ()
        if not several:
            raise ValueError("Name at least two scenes; the list of them is empty")
        first, *rest = several
        further = others if isinstance(others, list | tuple) else (others,)
        return {**given, "source": first, "scenes": (*rest, *further)}


class MergeResult(ScenesWritten):
    """The merged scene.

    Attributes:
        counts: number of Gaussians of each scene, the first one first.
    """

    counts: tuple[int, ...]


def run(
    request: MergeRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> MergeResult:
    """Merge scenes; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        SceneFileError: a scene cannot be read, or the result not be written.
    """
    from octasplat.engine.files import read_metadata
    from octasplat.engine.gaussians.merge import merge_scenes
    from octasplat.engine.gaussians.scene_metadata import merge_metadata
    from octasplat.engine.operations.scene_io import (
        check_edited_output,
        describe_edit,
        open_scene_about,
        write_edited_scene,
    )

    first: Path = request.source
    sources = (first, *request.scenes)
    check_edited_output("merge", request, request.output, request.scenes)
    facts = [read_metadata(source) for source in sources]
    # all about the first scene's origin, in which the result is written
    scenes = [open_scene_about(source, facts[0].origin_world, progress) for source in sources]
    # a dict keeps the order in which channels come
    every = dict.fromkeys(name for scene in scenes for name in scene.channels)
    for source, scene in zip(sources, scenes, strict=True):
        if missing := ", ".join(name for name in every if name not in scene.channels):
            emit_warning(progress, f"{source}: has no channel {missing}; it is 0 there.")
    merged = merge_scenes(scenes, request.sh_degree)
    merged_facts = merge_metadata(list(zip(scenes, facts, strict=True)))
    if merged_facts.georeference is None and any(each.georeference is not None for each in facts):
        emit_warning(progress, "The scenes have different georeferences; the merged scene has none.")
    stop_if(should_stop)
    written = write_edited_scene(
        first,
        merged,
        request.output,
        progress,
        edit_record=describe_edit("merge", options_of(MergeOptions, request), gaussians=len(merged)),
        facts=merged_facts,
    )
    return MergeResult(
        files=written.files, folder=written.folder, notes=(written.sentence,), counts=tuple(map(len, scenes))
    )


OPERATION = Operation("merge", "Put scenes together.", MergeRequest, MergeOptions, run)
