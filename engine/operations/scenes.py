"""Scenes that operations read and write, with a word on what reading or writing loses."""

from collections.abc import Sequence
from pathlib import Path

from octasplat.engine.errors import ConfigError
from octasplat.engine.events import Listener, Noted, Warned
from octasplat.engine.files import (
    ExportOptions,
    export_losses,
    export_scene,
    exporter_for,
    read_scene,
)
from octasplat.engine.gaussians.flattening import ImportReport
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_facts import SceneFacts
from octasplat.engine.run_folder import is_run, not_exported


def open_scene(path: Path, progress: Listener, *, drop_invalid: bool = False) -> FlatGaussians:
    """Return the Gaussians of a file of any format or of a run's folder.

    Args:
        path: the file or folder.
        progress: told what reading lost: a warning if it changes the look, else a note.
        drop_invalid: leave out Gaussians with values that are not finite.

    Raises:
        SceneFileError: the file cannot be read.
    """
    gaussians, report = read_scene(path, drop_invalid=drop_invalid)
    tell_import_losses(path, report, progress)
    if is_run(path) and (left_out := not_exported(path)) is not None:
        progress(Warned(left_out))
    return gaussians


def tell_import_losses(path: Path, report: ImportReport, progress: Listener) -> None:
    """Tell what reading ``path`` lost: warnings for what changes the look, notes for the rest."""
    if report.dropped:
        progress(Noted(f"{path}: {report.dropped:,} Gaussians without finite values were left out."))
    if report.saturated:
        progress(Noted(f"{path}: {report.saturated:,} opacities of exactly 0 or 1 were made finite."))
    if report.flattened:
        loss = (
            f"{path}: {report.flattened:,} of {report.count:,} Gaussians were not flat and lost their "
            f"smallest extent, which was {report.median_thickness:.2g} of the next one in the median"
        )
        if 2 * report.thick > report.flattened:
            progress(Warned(f"{loss}; as flat Gaussians the scene will look different."))
        else:
            progress(Noted(f"{loss}."))
    for note in report.notes:
        progress(Noted(f"{path}: {note}"))


def check_target(output: Path, inputs: Sequence[Path]) -> None:
    """Check before long work that a scene can be written there.

    Raises:
        ConfigError: ``output`` is one of ``inputs``.
        SceneFileError: no format takes the name.
    """
    exporter_for(output)
    if any(path.exists() and output.resolve() == path.resolve() for path in inputs):
        raise ConfigError(f"{output}: would overwrite what the command reads; choose another -o.")


def write_scene(
    gaussians: FlatGaussians, facts: SceneFacts, target: Path, progress: Listener, *, warn: bool = True
) -> str:
    """Write a scene in the format of its name; return a sentence that says so.

    Args:
        gaussians: the scene.
        facts: what goes along with it.
        target: the file.
        progress: told what the format leaves out.
        warn: whether to tell that.

    Raises:
        SceneFileError: it cannot be written.
    """
    if warn:
        for text in export_losses(gaussians, [target], None):
            progress(Warned(text))
    export_scene(gaussians, target, ExportOptions(facts=facts))
    what = exporter_for(target).description.partition(";")[0]
    return f"Wrote {target}: {what}, {len(gaussians):,} Gaussians."
