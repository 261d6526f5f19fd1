"""``octasplat clean``: a scene without what nobody wants to see."""

from pathlib import Path
from typing import Any

import click

from octasplat.workers.cli.options import quiet_option


@click.command(short_help="Remove faint Gaussians, oversized ones and floaters.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The scene to write.")
@click.option("--dry-run", is_flag=True, help="Only count.")
@click.option(
    "--min-opacity",
    type=click.FloatRange(0, 1, max_open=True),
    help="Remove fainter ones.  [default: 0.01, below which they cannot be seen]",
)
@click.option("--min-scale", type=click.FloatRange(0), help="Remove those of a smaller standard deviation.")
@click.option(
    "--max-scale",
    type=click.FloatRange(0, min_open=True),
    help="Remove those of a larger standard deviation, in the scene's units.",
)
@click.option(
    "--floaters/--no-floaters", default=True, show_default=True, help="Remove small groups by themselves."
)
@click.option(
    "--min-group", type=click.IntRange(2), help="Smaller groups are floaters.  [default: 20 Gaussians]"
)
@click.option(
    "--link",
    type=click.FloatRange(0, min_open=True),
    help="Neighbours belong together up to this many times their summed standard deviations.  [default: 1]",
)
@click.option(
    "--near",
    "near_share",
    type=click.FloatRange(0, 1, max_open=True),
    default=0.25,
    show_default=True,
    metavar="SHARE",
    help="Where IN is the folder of a run: remove those nearer to the camera of a training view than this "
    "share of the distance at which the sparse points around it begin; 0 for none.",
)
@quiet_option
def clean(
    source: Path, output: Path | None, dry_run: bool, near_share: float, quiet: bool, **given: Any
) -> None:
    """Remove Gaussians of IN that cannot be seen, are too large, too near to a camera, or float.

    octasplat info IN tells how large and how opaque they are.
    """
    if (output is None) != dry_run:
        raise click.UsageError("Name the result with -o, or say --dry-run.")

    from octasplat.engine.edit.cleaning import CleanOptions
    from octasplat.engine.edit.cleaning import clean as find_clean
    from octasplat.engine.errors import ConfigError
    from octasplat.engine.files import read_facts
    from octasplat.engine.run_folder import is_run, run_near_zones
    from octasplat.workers.cli.editing import checked_options, speaker, targets_for, write_scene
    from octasplat.workers.cli.scene_files import open_scene
    from octasplat.workers.cli.signals import orderly_termination

    options: CleanOptions = checked_options(CleanOptions, given)
    targets = targets_for(output, [source], [source]) if output is not None else ()
    gaussians = open_scene(source, quiet=quiet)
    with orderly_termination():
        zones = run_near_zones(source, near_share) if near_share > 0 and is_run(source) else None
        keep, report = find_clean(gaussians, options, zones)
        say = click.echo if dry_run else speaker(quiet)
        say(
            f"{source}: {len(gaussians):,} Gaussians; {report.faint:,} too faint, "
            f"{report.small:,} too small, {report.large:,} too large, "
            f"{report.near:,} too near to a camera, "
            f"{report.floating:,} in {report.groups:,} groups of floaters; "
            f"{report.kept:,} kept."
        )
        if not keep.any():
            raise ConfigError(
                f"{source}: nothing of it would be left; ask for less (octasplat info tells its sizes and "
                "opacities)."
            )
        for target in targets:
            write_scene(gaussians.select(keep), read_facts(source), target, say)
