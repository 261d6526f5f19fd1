"""A reconstruction with its progress shown and its signals heard, as several commands need it."""

from pathlib import Path

import click

from octasplat.engine.config import ReconstructionConfig
from octasplat.engine.errors import Cancelled, ExportFailed, NoSpaceLeft
from octasplat.engine.evaluate.summary import run_summary
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.stages import stopping
from octasplat.workers.cli.progress import show_progress
from octasplat.workers.cli.signals import Stopped, stop_on_signals


def run_reconstruction(
    scene: Path,
    output: Path,
    config: ReconstructionConfig,
    *,
    resume: bool,
    threads: int,
    quiet: bool,
    resumes_by_itself: bool = False,
) -> None:
    """Reconstruct, show the progress, and at the end what was reached.

    With ``resumes_by_itself`` a user who stops is not told of ``--resume``, which the command does not have.

    Raises:
        Stopped: by SIGINT or SIGTERM, after a checkpoint.
        ExportFailed: some files could not be written; what there is was shown.
        OctasplatError: as :func:`octasplat.engine.pipeline.reconstruct` does.
    """
    with stop_on_signals() as should_stop:
        try:
            with show_progress(quiet=quiet, should_stop=should_stop) as listener:
                reconstruct(
                    scene,
                    output,
                    config,
                    resume=resume,
                    threads=threads,
                    listener=stopping(listener, should_stop),
                    should_stop=should_stop,
                )
        except Cancelled as error:
            message = "Stopped; the same command goes on." if resumes_by_itself else str(error)
            raise Stopped(message, should_stop.exit_code) from None
        except NoSpaceLeft as error:
            how = "" if resumes_by_itself else " with --resume"
            raise NoSpaceLeft(f"{error} Then the same command{how} goes on.") from error
        except ExportFailed as error:
            for line in run_summary(output, [name for name in config.exports if (output / name).exists()]):
                click.echo(line)
            again = f"Mend that or name others with --exports, and add --resume: {output} goes on from there."
            raise ExportFailed(f"{error} {again}") from None
    if not quiet:
        for line in run_summary(output, config.exports):
            click.echo(line)
