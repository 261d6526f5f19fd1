"""Scenes that commands are given: read, with a word on stderr about what reading lost."""

from pathlib import Path

import click

from engine.files import lost_channels, read_scene
from engine.gaussians.flattening import ImportReport
from engine.gaussians.model import FlatGaussians


def open_scene(path: Path, *, drop_invalid: bool = False, quiet: bool = False) -> FlatGaussians:
    """The Gaussians of a file of any format or of a run's folder; losses are told on stderr.

    Args:
        path: the file or folder.
        drop_invalid: leave out Gaussians with values that are not finite.
        quiet: tell warnings only.

    Raises:
        SceneFileError: the file cannot be read.
    """
    gaussians, report = read_scene(path, drop_invalid=drop_invalid)
    for line in losses(path, report):
        if not quiet or line.startswith("Warning"):
            click.echo(line, err=True)
    return gaussians


def warn_of_lost_channels(gaussians: FlatGaussians, target: Path, format_name: str | None = None) -> None:
    """Tell on stderr which named channels of a scene the format of ``target`` will leave out.

    Raises:
        SceneFileError: there is no such format.
    """
    if text := lost_channels(gaussians, target, format_name):
        click.echo(f"Warning: {text}", err=True)


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
