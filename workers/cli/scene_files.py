"""Scenes that commands are given: read, with a word on stderr about what reading lost."""

from collections.abc import Callable
from pathlib import Path

import click

from octasplat.engine.files import export_losses
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.workers.telling.losses import open_scene as read_telling


def open_scene(path: Path, *, drop_invalid: bool = False, quiet: bool = False) -> FlatGaussians:
    """The Gaussians of a file of any format or of a run's folder; losses are told on stderr.

    Args:
        path: the file or folder.
        drop_invalid: leave out Gaussians with values that are not finite.
        quiet: tell warnings only.

    Raises:
        SceneFileError: the file cannot be read.
    """
    return read_telling(path, speaker_of_losses(quiet), drop_invalid=drop_invalid)


def speaker_of_losses(quiet: bool) -> Callable[[str], None]:
    """Tells on stderr what reading lost; if ``quiet``, only what changes the look."""

    def say(line: str) -> None:
        if not quiet or line.startswith("Warning"):
            click.echo(line, err=True)

    return say


def warn_of_losses(gaussians: FlatGaussians, target: Path, format_name: str | None = None) -> None:
    """Tell on stderr what of a scene the format of ``target`` will leave out.

    Raises:
        SceneFileError: there is no such format.
    """
    for text in export_losses(gaussians, [target], format_name):
        click.echo(f"Warning: {text}", err=True)
