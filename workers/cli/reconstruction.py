"""A reconstruction with its progress shown and its signals heard, as several commands need it."""

import click

from octasplat.engine.core.errors import DiskFullError, ExportError
from octasplat.engine.operations.reconstruct import OPERATION, ReconstructRequest, run_config
from octasplat.workers.cli.request_options import run_operation
from octasplat.workers.cli.signals import StoppedError


def run_reconstruction(
    request: ReconstructRequest, *, threads: int, quiet: bool, resumes_automatically: bool = False
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

    output = request.output
    try:
        run_operation(OPERATION, request, quiet=quiet, threads=threads, is_stoppable=True)
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
            click.echo(line)
        again = f"Mend that or name others with --exports, and add --resume: {output} goes on from there."
        raise ExportError(f"{error} {again}") from None
