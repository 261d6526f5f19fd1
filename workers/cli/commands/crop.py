"""``octasplat crop``: part of a scene."""

from pathlib import Path

import click

from octasplat.workers.cli.options import quiet_option, selection_options


@click.command(short_help="Keep part of a scene.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The scene to write.")
@selection_options
@quiet_option
def crop(
    source: Path,
    output: Path,
    where: str | None,
    box: tuple[float, ...] | None,
    sphere: tuple[float, ...] | None,
    inverse: bool,
    quiet: bool,
) -> None:
    """Keep those Gaussians of IN for which all that is given holds; boxes and spheres ask for centres.

    octasplat info IN tells where they lie.
    """
    if where is None and box is None and sphere is None:
        raise click.UsageError("Say what to keep: --box, --sphere or --where.")

    from octasplat.engine.edit.choices import Selection
    from octasplat.engine.edit.selection import chosen_by
    from octasplat.engine.errors import ConfigError
    from octasplat.engine.files import read_facts
    from octasplat.workers.cli.editing import checked_options, speaker, targets_for, write_scene
    from octasplat.workers.cli.scene_files import open_scene
    from octasplat.workers.cli.signals import orderly_termination

    (target,) = targets_for(output, [source], [source])
    gaussians = open_scene(source, quiet=quiet)
    given = {"where": where, "box": box, "sphere": sphere, "inverse": inverse}
    selection: Selection = checked_options(Selection, given)
    keep = chosen_by(gaussians, selection)
    if not keep.any():
        low, high = gaussians.means_world.min(axis=0), gaussians.means_world.max(axis=0)
        bounds = " to ".join(" ".join(f"{value:.4g}" for value in corner) for corner in (low, high))
        raise ConfigError(
            f"{source}: nothing of it would be kept; its centres lie in {bounds} (octasplat info tells where "
            "its solid part is)."
        )
    say = speaker(quiet)
    say(f"{source}: {int(keep.sum()):,} of {len(keep):,} Gaussians kept.")
    with orderly_termination():
        write_scene(gaussians.select(keep), read_facts(source), target, say)
