"""Several files of one scene; one that cannot be written takes none of the others along."""

from collections.abc import Callable, Sequence
from pathlib import Path

from octasplat.engine.core.errors import CancelledError, DiskFullError, OctasplatError
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.registry import Exporter, exporter_for
from octasplat.engine.files.write_files import export_scene
from octasplat.engine.gaussians.model import FlatGaussians


def export_batch(
    targets: Sequence[Path],
    prepare: Callable[[Exporter], tuple[FlatGaussians, ExportOptions]],
    on_done: Callable[[int], None],
    format: str | None = None,
) -> tuple[tuple[Path, ...], str | None]:
    """Write a scene to several files, all of them that can be written.

    Args:
        targets: the files; their names say the formats.
        prepare: makes what is written in a format: the scene, and how.
        on_done: called with the number of files dealt with, after each; it may raise to stop.
        format: name of the format of all of them, if their names do not say it.

    Returns:
        The files that were written, and what could not be written and why, in a sentence for each file, or
        None.

    Raises:
        DiskFullError: there is no room for a file.
    """
    written: list[Path] = []
    failed: list[str] = []
    for done, target in enumerate(targets, start=1):
        try:
            gaussians, options = prepare(exporter_for(target, format))
            written += export_scene(gaussians, target, options, format)
        except (DiskFullError, CancelledError):
            raise  # the others would find no room either, and whoever makes room goes on from here
        except OctasplatError as error:
            failed.append(str(error).replace(f"{target}", target.name).rstrip("."))
        except Exception as error:  # noqa: BLE001 - a fault of one format costs none of the others
            failed.append(f"{target.name}: {type(error).__name__}: {error}")
        on_done(done)
    if not failed:
        return tuple(written), None
    count = f"{len(failed)} of {len(targets)} files" if len(targets) > 1 else "The file"
    return tuple(written), f"{count} could not be written: {'; '.join(failed)}."


def targets_with_known_format(targets: Sequence[Path]) -> list[Path]:
    """Return those whose names say a format."""
    return [target for target in targets if _has_known_format(target)]


def _has_known_format(target: Path) -> bool:
    try:
        exporter_for(target)
    except OctasplatError:
        return False
    return True
