"""A reconstruction with its progress shown and its signals heard, as several commands need it."""

import functools

from octasplat.engine.core.errors import DiskFullError, ExportError, OctasplatError
from octasplat.engine.operations.reconstruct import (
    OPERATION,
    ReconstructRequest,
    run_config,
    scene_folder,
)
from octasplat.workers.cli.printing import Printer
from octasplat.workers.cli.request_options import run_operation
from octasplat.workers.cli.signals import StoppedError


def run_reconstruction(
    request: ReconstructRequest, printer: Printer, *, threads: int, resumes_automatically: bool = False
) -> None:
    """Reconstruct, show the progress, and at the end what was reached.

    With ``resumes_automatically`` the message on a stop leaves out ``--resume``, which the command lacks.

    Raises:
        StoppedError: by SIGINT or SIGTERM, after a checkpoint.
        ExportError: some files could not be written; what there is was shown.
        OctasplatError: as :func:`octasplat.engine.pipeline.reconstruction` does.
    """
    import octasplat.engine.pipeline  # noqa: F401 - pycolmap takes SIGTERM when imported, so before we do
    from octasplat.engine.evaluate.summary import summarize_run
    from octasplat.engine.runs.run_folder import CONFIG

    output = request.output
    is_resumed = request.resume and (output / CONFIG).exists()
    first_sentence = functools.partial(_estimate_sentence, request, threads, is_resumed)
    try:
        run_operation(
            OPERATION, request, printer, threads=threads, is_stoppable=True, first_sentence=first_sentence
        )
    except StoppedError as error:
        if resumes_automatically:
            raise StoppedError("Stopped; the same command goes on.", error.exit_code) from None
        raise
    except DiskFullError as error:
        how = "" if resumes_automatically else " with --resume"
        raise DiskFullError(f"{error} Then the same command{how} goes on.") from error
    except ExportError as error:
        written = [name for name in run_config(request).exports if (output / name).exists()]
        for line in summarize_run(output, written):
            printer.note(line)
        again = f"Mend that or name others with --exports, and add --resume: {output} goes on from there."
        raise ExportError(f"{error} {again}") from None


def _estimate_sentence(request: ReconstructRequest, threads: int, is_resumed: bool) -> str | None:
    """Return what a new run is to take; None where it goes on from where it is or nobody can tell."""
    from octasplat.engine.operations.estimate import estimate_scene
    from octasplat.engine.operations.photograph_sizes import photograph_sizes
    from octasplat.engine.poses.photographs import locate_scene

    if is_resumed:
        return None
    try:
        scene = locate_scene(scene_folder(request))
        found = estimate_scene(scene, run_config(request), photograph_sizes(scene), threads, request)
    except OctasplatError:  # the run refuses what cannot be read, in its own words
        return None
    return f"Estimate: {found.text}, within a factor of two."
