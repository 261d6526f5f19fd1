"""Scenes read from files, with a word on what reading lost."""

from collections.abc import Callable
from pathlib import Path

from octasplat.engine.files import read_scene
from octasplat.engine.gaussians.flattening import ImportReport
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.run_folder import is_run, not_exported


def open_scene(path: Path, say: Callable[[str], None], *, drop_invalid: bool = False) -> FlatGaussians:
    """The Gaussians of a file of any format or of a run's folder.

    Args:
        path: the file or folder.
        say: told in a sentence what was lost, or is left behind; one that changes the look begins with
            ``Warning:``.
        drop_invalid: leave out Gaussians with values that are not finite.

    Raises:
        SceneFileError: the file cannot be read.
    """
    gaussians, report = read_scene(path, drop_invalid=drop_invalid)
    for line in losses(path, report):
        say(line)
    if is_run(path) and (left_out := not_exported(path)) is not None:
        say(f"Warning: {left_out}")
    return gaussians


def losses(path: Path, report: ImportReport) -> tuple[str, ...]:
    """What was lost, a sentence each; those that change the look begin with ``Warning:``."""
    lines = []
    if report.dropped:
        lines.append(f"{path}: {report.dropped:,} Gaussians without finite values were left out.")
    if report.saturated:
        lines.append(f"{path}: {report.saturated:,} opacities of exactly 0 or 1 were made finite.")
    if report.flattened:
        loss = (
            f"{path}: {report.flattened:,} of {report.count:,} Gaussians were not flat and lost their "
            f"smallest extent, which was {report.median_thickness:.2g} of the next one in the median"
        )
        if 2 * report.thick > report.flattened:
            lines.append(f"Warning: {loss}; as flat Gaussians the scene will look different.")
        else:
            lines.append(f"{loss}.")
    lines.extend(f"{path}: {note}" for note in report.notes)
    return tuple(lines)
