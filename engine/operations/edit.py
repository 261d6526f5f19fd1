"""``edit``: a scene from its edited mesh."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from pydantic import Field

from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.core.threads import use_threads
from octasplat.engine.edit.edit_options import MeshToGaussiansOptions
from octasplat.engine.edit.reports import EditReport
from octasplat.engine.operations.base import (
    Operation,
    Options,
    ScenesWritten,
    emit_warning,
    never_stop,
    options_of,
    stop_if,
)
from octasplat.engine.operations.file_patterns import expand_patterns
from octasplat.engine.operations.sequence_request import SequenceRequest
from octasplat.engine.settings.fields import InputFile, Spelling


class EditOptions(MeshToGaussiansOptions, Options):
    """Options of which meshes become scenes, and how."""

    meshes: Annotated[tuple[InputFile, ...], Spelling(("--mesh",), metavar="MESH")] = Field(
        min_length=1,
        max_length=10_000,
        description="The edited mesh (.ply, .obj or .glb); several, or here a quoted pattern such as "
        "'frames/*.ply', are a sequence.",
    )


class EditRequest(EditOptions, SequenceRequest):
    """Bring an edited mesh of the scene back to Gaussians.

    The mesh is what octasplat export wrote for the scene, moved, bent, cut or copied in a mesh editor.
    Gaussians whose octagon stayed keep every bit. See docs/editing.md.
    """


class EditResult(ScenesWritten):
    """A scene for each mesh.

    Attributes:
        reports: what was found in each mesh and what became of it.
    """

    reports: tuple[EditReport, ...]


def run(
    request: EditRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> EditResult:
    """Recover the scene from each edited mesh; see :class:`octasplat.engine.operations.base.Run`.

    Tells the steps of a stage ``edit``, one for each of several meshes.

    Raises:
        OctasplatError: something cannot be read, matched or written.
    """
    from octasplat.engine.edit.mesh_to_gaussians import recover_gaussians
    from octasplat.engine.files import read_mesh, read_metadata
    from octasplat.engine.operations.scene_io import describe_edit, open_scene
    from octasplat.engine.operations.sequences import SceneSequence

    use_threads(threads)
    source: Path = request.source
    meshes = expand_patterns(request.meshes)
    recovery: MeshToGaussiansOptions = request
    frames = SceneSequence("edit", request, meshes)
    gaussians, origin = open_scene(source, progress), read_metadata(source).origin_world
    note = describe_edit("edit", options_of(EditOptions, request))
    reports, notes = [], []
    for number, path in enumerate(meshes):
        result, report = recover_gaussians(gaussians, read_mesh(path).about(origin), path, recovery)
        if recovery.axes == "auto":  # all frames of a sequence came the same way
            recovery = recovery.model_copy(update={"axes": report.axes})
            _warn_about_axes(path, report, progress)
        _warn_about_torn(report, progress)
        stop_if(should_stop)  # between two scenes of a sequence: what is written is whole
        notes += [*_report_text(path, report), frames.write(number, result, progress, note)]
        reports.append(report)
        frames.report(number, progress)
    frames.write_report([{"mesh": str(path)} for path in meshes], map(asdict, reports))
    return EditResult(files=frames.files, folder=frames.folder, notes=tuple(notes), reports=tuple(reports))


def _warn_about_axes(path: Path, report: EditReport, progress: EventListener) -> None:
    """Warn if a mesh seems to have been rotated between export and import."""
    if report.axes != report.axes_usual:
        emit_warning(
            progress,
            f"{path} came back along other axes than it was written with (as when a mesh changes format in "
            "Blender) and was turned back; if turning it was your edit, say --axes "
            f"{report.axes_usual}.",
        )


def _warn_about_torn(report: EditReport, progress: EventListener) -> None:
    if report.partial > report.snapped:
        emit_warning(
            progress,
            f"{report.partial - report.snapped:,} octagons moved with some corners only, which makes long "
            "streaks: select whole octagons in the editor (Select Linked) or say --whole-octagons.",
        )


def _report_text(path: Path, report: EditReport) -> list[str]:
    """Return a report in words, without counts of zero."""
    lines = [
        f"{path}: {report.moved:,} Gaussians moved, {report.unmoved:,} did not "
        f"(vertices found by {report.matched_by})."
    ]
    counts = (
        (report.deleted, "deleted with their octagons"),
        (report.copies, "added, as their octagons were duplicated"),
        (report.carried, "too faint for an octagon, moved as their neighbours"),
        (report.orphaned, "too faint for an octagon, deleted with their neighbours"),
        (report.mirrored, "mirrored with their surroundings"),
        (report.incomplete, "with missing corners"),
        (report.crumpled, "crumpled (folded, without area or far from flat)"),
        (report.flipped, "flipped against their surroundings"),
        (report.dropped, "left out as damaged"),
        (report.snapped, "moved in part, taken as a whole"),
    )
    lines += [f"  {count:,} {what}" for count, what in counts if count]
    if report.foreign_vertices:
        lines.append(f"  {report.foreign_vertices:,} vertices belong to no octagon and were passed over")
    if report.ambiguous_corners:
        lines.append(f"  {report.ambiguous_corners:,} corners were there more than once and were passed over")
    if report.moved:
        lines.append(
            f"  distance from an affine map, in standard deviations: median {report.residual_median:.2g}, "
            f"95th percentile {report.residual_p95:.2g}, largest {report.residual_max:.2g}"
            + (f"; {report.strained:,} above 0.3" if report.strained else "")
        )
    return lines


OPERATION = Operation(
    "edit", "Turn a mesh edited elsewhere back into Gaussians.", EditRequest, EditOptions, run
)
