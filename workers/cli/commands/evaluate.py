"""``octasplat evaluate``: measure a finished run again."""

from pathlib import Path

import click

from octasplat.workers.cli.options import quiet_option, threads_option


@click.command(short_help="Measure a finished run again.")
@click.argument("output", metavar="OUT", type=click.Path(path_type=Path))
@click.option(
    "--scene",
    type=click.Path(path_type=Path),
    help="Where the photographs are now, if they were moved or the run was downloaded.",
)
@click.option(
    "--on",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Measure all photographs of another folder (images/ and sparse/0 in the same world as the run's) "
    "instead; the results go to OUT/on/<its name>.",
)
@click.option(
    "--scales",
    metavar="N,N...",
    help="Measure smaller sizes instead, e.g. 2,4,8: renders at 1/2, 1/4 and 1/8 of the size against "
    "photographs made as small, with 1, 4 and 16 rays a pixel; into OUT/scales.json.",
)
@threads_option
@quiet_option
def evaluate(
    output: Path, scene: Path | None, on: Path | None, scales: str | None, threads: int, quiet: bool
) -> None:
    """Measure the run in the folder OUT again: metrics.json, report.html and renders/ are written anew."""
    if scales is not None:
        _evaluate_scales(output, scene, on, scales, threads, quiet)
        return
    if scene is not None and on is not None:
        raise click.UsageError("Choose one of --scene (the run's own photographs) and --on (others).")
    from octasplat.engine.config import read_config
    from octasplat.engine.evaluate import runs
    from octasplat.engine.run_folder import CONFIG
    from octasplat.workers.cli.progress import show_progress
    from octasplat.workers.cli.signals import orderly_termination
    from octasplat.workers.telling.wording import measured_summary, run_summary

    with orderly_termination(), show_progress(quiet=quiet) as listener:
        metrics = runs.evaluate(output, scene=scene, on=on, threads=threads, listener=listener)
    if on is not None and not quiet:
        for line in measured_summary(metrics):
            click.echo(line)
    elif not quiet:
        for line in run_summary(output, read_config(output / CONFIG).exports):
            click.echo(line)


def _evaluate_scales(
    output: Path, scene: Path | None, on: Path | None, scales: str, threads: int, quiet: bool
) -> None:
    """Measure smaller sizes and tell what was found."""
    try:
        numbers = sorted({int(text) for text in scales.split(",")})
    except ValueError:
        numbers = [0]
    if on is not None or numbers[0] < 1:
        raise click.UsageError("--scales takes whole numbers such as 2,4,8, and the run's own photographs.")
    from octasplat.engine.evaluate.runs import evaluate_scales
    from octasplat.workers.cli.progress import show_progress
    from octasplat.workers.cli.signals import orderly_termination

    with orderly_termination(), show_progress(quiet=quiet) as listener:
        found = evaluate_scales(output, numbers, scene=scene, threads=threads, listener=listener)
    if not quiet:
        for scale, row in found.items():
            told = ", ".join(f"{psnr:.2f} dB with {rays}" for rays, psnr in row.items())
            click.echo(f"{scale} of the size: {told} ray(s) a pixel")
