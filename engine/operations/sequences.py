"""Sequences: many meshes read in turn, and a scene written for each."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener, PhaseProgress
from octasplat.engine.core.writing import write_json
from octasplat.engine.edit.changed_run import check_new_run
from octasplat.engine.files import read_metadata
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.operations.scene_io import check_scenes, is_run_output, write_edited_scene, write_scene
from octasplat.engine.operations.sequence_request import SequenceRequest
from octasplat.engine.operations.written_files import check_targets


def targets_for(output: Path, sources: Sequence[Path]) -> tuple[Path, ...]:
    """Return the file to write for each source: ``output`` for one, numbered files for several.

    Several need a pattern such as ``out/%04d.ply``, a folder (names as those of the sources, with a number
    where several have one stem), or a plain name to which ``_0000`` and so on is added.

    Raises:
        ConfigError: two targets are the same.
    """
    if "%" in output.name:
        # a pattern: numbered even for one source
        try:
            targets = [output.with_name(output.name % number) for number in range(len(sources))]
        except (TypeError, ValueError):
            raise ConfigError(f"{output}: is no pattern; write one number as in frame_%04d.ply.") from None
    elif len(sources) == 1:
        targets = [output]
    elif output.suffix:
        targets = [
            output.with_name(f"{output.stem}_{number:04d}{output.suffix}") for number in range(len(sources))
        ]
    else:
        # names differ by more than case, for file systems that ignore it
        uses = Counter(source.stem.casefold() for source in sources)
        targets = [
            output / (f"{stem}_{number:04d}.ply" if uses[stem.casefold()] > 1 else f"{stem}.ply")
            for number, stem in enumerate(source.stem for source in sources)
        ]
    if len(set(targets)) < len(targets):
        raise ConfigError(f"{output}: gives two results the same name; write a pattern such as %04d.ply.")
    return tuple(targets)


class SceneSequence:
    """Writer of a scene for each mesh of a sequence, or of one scene for one mesh.

    Args:
        verb: what writes them.
        request: names the scene that is changed and the output; see :func:`targets_for`, and for one mesh
            :func:`octasplat.engine.operations.scene_io.is_run_output`.
        meshes: those that each make a scene.
        inputs: what else is read.

    Attributes:
        files: those that were written.
        folder: of the run that was written; None for files.

    Raises:
        ConfigError: a scene or the report would overwrite an input, or two scenes have the same name.
        OutputError: the folder is taken, or a file there and not by the verb.
        SceneFileError: no format takes the name.
    """

    def __init__(
        self, verb: str, request: SequenceRequest, meshes: Sequence[Path], inputs: Sequence[Path] = ()
    ) -> None:
        source, output = request.source, request.output
        reads, reports = [source, *meshes, *inputs], [] if request.report is None else [request.report]
        self._source = source
        self._is_run = len(meshes) == 1 and is_run_output(source, output)
        if self._is_run:
            check_new_run(output)
            self._targets: tuple[Path, ...] = (output,)
            check_targets(verb, reports, reads, overwrite=request.overwrite)
        else:
            self._targets = targets_for(output, meshes)
            # resolved, so that two spellings of one path are noticed
            if {path.resolve() for path in reports} & {target.resolve() for target in self._targets}:
                raise ConfigError(
                    f"{request.report}: would overwrite a result; choose another name for the report."
                )
            check_scenes(verb, self._targets, reads, overwrite=request.overwrite, others=reports)
        self._report = request.report
        self.files: tuple[Path, ...] = ()
        self.folder: Path | None = None

    def write(
        self, number: int, gaussians: FlatGaussians, progress: EventListener, note: Mapping[str, object]
    ) -> str:
        """Write the scene of the mesh with this number; return a sentence about it."""
        target = self._targets[number]
        if self._is_run:
            counted = {**note, "gaussians": len(gaussians)}
            written = write_edited_scene(self._source, gaussians, target, progress, edit_record=counted)
            self.files, self.folder = written.files, written.folder
            return written.sentence
        self.files = (*self.files, target)
        # the losses are the same for each frame
        return write_scene(gaussians, read_metadata(self._source), target, progress, warn=number == 0)

    def report(self, number: int, progress: EventListener) -> None:
        """Report that the scene of the mesh with this number is written, if there are several."""
        if len(self._targets) > 1:
            progress(PhaseProgress("edit", number + 1, len(self._targets)))

    def write_report(
        self, meshes: Sequence[Mapping[str, object]], reports: Iterable[Mapping[str, object]]
    ) -> None:
        """Write the counts of all meshes, if a report is requested."""
        if self._report is None:
            return
        if not self._is_run:
            self.files = (*self.files, self._report)
        rows = zip(meshes, self._targets, reports, strict=True)
        write_json(self._report, [{**mesh, "output": str(target), **report} for mesh, target, report in rows])
