"""Several files of one scene; one that cannot be written takes none of the others along."""

from collections.abc import Callable, Sequence
from pathlib import Path

from octasplat.engine.errors import NoSpaceLeft, OctasplatError
from octasplat.engine.files.exporting import export_losses, export_scene
from octasplat.engine.files.options import ExportOptions
from octasplat.engine.files.registry import exporter_for
from octasplat.engine.gaussians.model import FlatGaussians


def export_files(
    gaussians: FlatGaussians,
    folder: Path,
    names: Sequence[str],
    options: ExportOptions,
    plain: Callable[[], FlatGaussians],
    on_done: Callable[[int], None],
    on_loss: Callable[[str], None],
) -> str | None:
    """Write ``gaussians`` to files in ``folder``, all of them that can be written.

    Args:
        gaussians: the scene.
        folder: where to.
        names: of the files; they say the formats.
        options: of all of them.
        plain: makes the scene for formats that have one colour for each Gaussian.
        on_done: told how many files have been dealt with, after each; it may raise to stop.
        on_loss: told in a sentence each thing of the scene that formats cannot hold, before the first file.

    Returns:
        What could not be written and why, in a sentence for each file, or None.

    Raises:
        NoSpaceLeft: there is no room for a file.
    """
    failed: list[str] = []
    for lost in export_losses(gaussians, [folder / name for name in names if _known(name)]):
        on_loss(lost)
    for done, name in enumerate(names, start=1):
        try:
            chosen = gaussians if exporter_for(folder / name).holds_harmonics else plain()
            export_scene(chosen, folder / name, options)
        except NoSpaceLeft:
            raise  # the others would find none either, and whoever makes room goes on from here
        except OctasplatError as error:
            failed.append(str(error).replace(f"{folder / name}", name).rstrip("."))
        except Exception as error:  # noqa: BLE001 - a fault of one format costs none of the others
            failed.append(f"{name}: {type(error).__name__}: {error}")
        on_done(done)
    if not failed:
        return None
    count = f"{len(failed)} of {len(names)} files" if len(names) > 1 else "The file"
    return f"{count} could not be written: {'; '.join(failed)}."


def _known(name: str) -> bool:
    """Whether a file's name says a format."""
    try:
        exporter_for(Path(name))
    except OctasplatError:
        return False
    return True
