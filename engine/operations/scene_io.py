"""Reading and writing of operations' scenes, with warnings about what a format drops."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel

from octasplat.engine.core.events import EventListener, Noted, Warned
from octasplat.engine.core.local_origin import Origin, describe_origin
from octasplat.engine.files import (
    ExportOptions,
    dropped_on_export,
    export_scene,
    exporter_for,
    read_metadata,
    read_scene,
)
from octasplat.engine.gaussians.flattening import ImportReport
from octasplat.engine.gaussians.merge import about_origin
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.operations.base import SourceRequest
from octasplat.engine.operations.written_files import check_targets
from octasplat.engine.runs.run_folder import CONFIG, is_run, unexported_parts
from octasplat.engine.settings.fields import map_named_files

MAX_ROUNDING = 0.01
"""Positions that are rounded to more than this share of a Gaussian's size are worth a warning."""


def open_scene(path: Path, progress: EventListener, *, folder: Path | None = None) -> FlatGaussians:
    """Return the Gaussians of a file of any format or of a run's folder, see :func:`open_reported_scene`."""
    return open_reported_scene(path, progress, folder=folder)[0]


def open_reported_scene(
    path: Path, progress: EventListener, *, drop_invalid: bool = False, folder: Path | None = None
) -> tuple[FlatGaussians, ImportReport]:
    """Return the Gaussians of a file of any format or of a run's folder, and what reading them lost.

    Args:
        path: the file or folder.
        progress: receives what reading lost: a warning if it changes the look, else a note.
        drop_invalid: leave out Gaussians with values that are not finite.
        folder: for files that hold a large scene, see :func:`octasplat.engine.gaussians.flattening.flatten`.

    Raises:
        SceneFileError: the file cannot be read.
    """
    gaussians, report = read_scene(path, drop_invalid=drop_invalid, folder=folder)
    report_dropped_on_import(path, report, progress)
    if is_run(path) and (left_out := unexported_parts(path)) is not None:
        progress(Warned(left_out))
    return gaussians, report


def open_scene_about(path: Path, origin_world: Origin, progress: EventListener) -> FlatGaussians:
    """Return the Gaussians of a file about the local origin of another scene.

    A warning says where this costs digits, as one of both scenes has large coordinates and the other has not.

    Raises:
        SceneFileError: the file cannot be read.
    """
    scene, own = open_scene(path, progress), read_metadata(path).origin_world
    moved = about_origin(scene, own, origin_world)
    # rounding of float32 at the farthest mean
    step = float(np.spacing(np.abs(moved.means_world).max(initial=0.0)))
    sizes = float(np.median(scene.scales)) if len(scene) else 0.0
    if own != origin_world and step > MAX_ROUNDING * sizes:
        progress(
            Warned(
                f"{path} lies far from the other scene, about whose origin {describe_origin(origin_world)} "
                f"it is put: 32 bits keep its positions to {step:.2g} units only, where its Gaussians are "
                f"{sizes:.2g} wide; move it beside the other with octasplat transform --translate first."
            )
        )
    return moved


def report_dropped_on_import(path: Path, report: ImportReport, progress: EventListener) -> None:
    """Report what reading ``path`` dropped: warnings for what changes the look, notes for the rest."""
    if report.dropped:
        progress(Noted(f"{path}: {report.dropped:,} Gaussians without finite values were left out."))
    if report.saturated:
        progress(Noted(f"{path}: {report.saturated:,} opacities of exactly 0 or 1 were made finite."))
    if report.flattened:
        loss = (
            f"{path}: {report.flattened:,} of {report.count:,} Gaussians were not flat and lost their "
            f"smallest extent, which was {report.median_thickness:.2g} of the next one in the median"
        )
        if 2 * report.thick > report.flattened:  # more than half: the scene consists of thick Gaussians
            progress(Warned(f"{loss}; as flat Gaussians the scene will look different."))
        else:
            progress(Noted(f"{loss}."))
    for note in report.notes:
        progress(Noted(f"{path}: {note}"))


def check_scenes(
    verb: str,
    outputs: Sequence[Path],
    inputs: Sequence[Path | None],
    *,
    overwrite: bool,
    others: Sequence[Path] = (),
    format: str | None = None,
) -> None:
    """Check before long work that scenes can be written.

    Args:
        verb: what writes them.
        outputs: the files of the scenes.
        inputs: what is read.
        overwrite: whether files are replaced that the verb did not write.
        others: other files that are written.
        format: name of the format, if the files' names do not say it.

    Raises:
        ConfigError: one of them is read.
        OutputError: one of them is there and not by the verb.
        SceneFileError: no format takes a name.
    """
    # some formats write a second file
    beside = [path for output in outputs for path in exporter_for(output, format).beside(output)]
    check_targets(verb, [*outputs, *beside, *others], inputs, overwrite=overwrite)


def write_scene(
    gaussians: FlatGaussians,
    facts: SceneMetadata,
    target: Path,
    progress: EventListener,
    *,
    warn: bool = True,
) -> str:
    """Write a scene in the format of its name; return a sentence about it.

    Args:
        gaussians: the scene.
        facts: what goes along with it.
        target: the file.
        progress: receives a warning for each thing that the format leaves out.
        warn: whether to send these warnings.

    Raises:
        SceneFileError: it cannot be written.
    """
    if warn:
        for text in dropped_on_export(gaussians, [target], facts=facts):
            progress(Warned(text))
    export_scene(gaussians, target, ExportOptions(facts=facts))
    what = exporter_for(target).description.partition(";")[0]
    return f"Wrote {target}: {what}, {len(gaussians):,} Gaussians."


def is_run_output(source: Path, output: Path) -> bool:
    """Return whether a changed scene is written as a run's folder: it is a run's, and no file is named."""
    return is_run(source) and not output.suffix


def check_edited_output(
    verb: str, request: SourceRequest, output: Path, inputs: Sequence[Path | None] = ()
) -> None:
    """Check before long work that a changed scene can be written to ``output``, a file or a run's folder.

    Args:
        verb: what changes it.
        request: names the scene that is changed.
        output: where the other one goes.
        inputs: what else is read.

    Raises:
        ConfigError: ``output`` is one of the inputs.
        OutputError: the folder is taken, or the file there and not by the verb.
        SceneFileError: no format takes the name.
    """
    if is_run_output(request.source, output):
        from octasplat.engine.edit.changed_run import check_new_run  # here, as most who read scenes edit none

        check_new_run(output)
    else:
        check_scenes(verb, [output], [request.source, *inputs], overwrite=request.overwrite)


@dataclass(frozen=True)
class WrittenScene:
    """An edited scene that was written.

    Attributes:
        files: its files.
        sentence: says so.
        folder: of the run that it became; None for a file.
    """

    files: tuple[Path, ...]
    sentence: str
    folder: Path | None = None


def write_edited_scene(
    source: Path,
    gaussians: FlatGaussians,
    output: Path,
    progress: EventListener,
    *,
    edit_record: Mapping[str, object],
    facts: SceneMetadata | None = None,
    matrix: Float[np.ndarray, "4 4"] | None = None,
) -> WrittenScene:
    """Write the edited version of ``source``: a scene file, or a run folder with the files that stay valid.

    Whether it is a run folder depends on source and output, see :func:`is_run_output`; a scene file takes
    neither ``edit_record`` nor ``matrix``.

    Args:
        source: the scene that was edited, a file or a run's folder.
        gaussians: the Gaussians after the edit.
        output: the scene file or the new run's folder.
        progress: receives a warning for each thing that the output cannot hold.
        edit_record: description of the edit for the run's ``edits.json``; unused for a scene file.
        facts: metadata of the scene as a whole; None takes that of the source.
        matrix: affine map from the source's world to the edited scene's, by which a run's cameras follow;
            None if the world frame is unchanged. Unused for a scene file.
    """
    if not is_run_output(source, output):
        return WrittenScene(
            (output,), write_scene(gaussians, facts or read_metadata(source), output, progress)
        )
    from octasplat.engine.edit.changed_run import write_edited_run  # here, as most who read scenes edit none

    for warning in write_edited_run(source, gaussians, output, edit_record, facts=facts, matrix=matrix):
        progress(Warned(warning))
    files = tuple(sorted(path for path in output.rglob("*") if path.is_file()))
    what = "a run" if (output / CONFIG).exists() else "a scene"  # what was sheared has no cameras any more
    sentence = f"Wrote {output}: {what} with {len(gaussians):,} Gaussians."
    return WrittenScene(files, sentence, folder=output)


def describe_edit(name: str, options: BaseModel, **counts: int) -> dict[str, object]:
    """Return the record of an edit for ``edits.json``, as JSON values; files by name only.

    Args:
        name: the verb.
        options: what was asked for.
        counts: numbers of Gaussians that it changed.
    """
    # names only: the folders of a machine say nothing elsewhere
    requested = map_named_files(options, lambda path: Path(path.name))
    recorded = type(options).model_construct(**requested).model_dump(mode="json", exclude_defaults=True)
    return {"operation": name, **recorded, **counts}
