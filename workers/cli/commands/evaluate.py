"""``octasplat evaluate``: measure a finished run again."""

from pathlib import Path

import click

from workers.cli.options import quiet_option, threads_option


@click.command(short_help="Measure a finished run again.")
@click.argument("output", metavar="OUT", type=click.Path(path_type=Path))
@click.option(
    "--scene",
    type=click.Path(path_type=Path),
    help="Where the photographs are now, if they were moved or the run was downloaded.",
)
@threads_option
@quiet_option
def evaluate(output: Path, scene: Path | None, threads: int, quiet: bool) -> None:
    """Measure the run in the folder OUT again: metrics.json, report.html and renders/ are written anew."""
    from engine import pipeline
    from engine.config import read_config
    from engine.run_folder import CONFIG
    from workers.cli.progress import show_progress
    from workers.cli.signals import orderly_termination
    from workers.telling.wording import run_summary

    with orderly_termination(), show_progress(quiet=quiet) as listener:
        pipeline.evaluate(output, scene=scene, threads=threads, listener=listener)
    if not quiet:
        for line in run_summary(output, read_config(output / CONFIG).exports):
            click.echo(line)
