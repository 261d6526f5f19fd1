"""``octasplat crop``: part of a scene."""

from pathlib import Path

import click

from workers.cli.options import quiet_option


@click.command(short_help="Keep a box or a sphere of a scene.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The scene to write.")
@click.option(
    "--box",
    nargs=6,
    type=float,
    metavar="X0 Y0 Z0 X1 Y1 Z1",
    help="Keep what lies between two corners, smallest coordinates first.",
)
@click.option("--sphere", nargs=4, type=float, metavar="X Y Z R", help="Keep what lies in a sphere.")
@click.option("--inverse", is_flag=True, help="Keep the rest instead.")
@quiet_option
def crop(
    source: Path,
    output: Path,
    box: tuple[float, ...] | None,
    sphere: tuple[float, ...] | None,
    inverse: bool,
    quiet: bool,
) -> None:
    """Keep those Gaussians of IN whose centre lies in a box or a sphere; with both, in both."""
    if box is None and sphere is None:
        raise click.UsageError("Say what to keep: --box or --sphere.")

    import numpy as np

    from engine.edit.selection import inside_box, inside_sphere
    from engine.errors import ConfigError
    from workers.cli.editing import speaker, targets_for, write_scene
    from workers.cli.scene_files import open_scene
    from workers.cli.signals import orderly_termination

    (target,) = targets_for(output, [source], [source])
    gaussians = open_scene(source, quiet=quiet)
    keep = np.ones(len(gaussians), dtype=bool)
    if box is not None:
        keep &= inside_box(gaussians, np.array(box[:3]), np.array(box[3:]))
    if sphere is not None:
        keep &= inside_sphere(gaussians, np.array(sphere[:3]), sphere[3])
    if inverse:
        keep = ~keep
    if not keep.any():
        low, high = gaussians.means_world.min(axis=0), gaussians.means_world.max(axis=0)
        bounds = " to ".join(" ".join(f"{value:.4g}" for value in corner) for corner in (low, high))
        raise ConfigError(f"{source}: nothing of it would be kept; its centres lie in {bounds}.")
    say = speaker(quiet)
    say(f"{source}: {int(keep.sum()):,} of {len(keep):,} Gaussians kept.")
    with orderly_termination():
        write_scene(gaussians.select(keep), target, say)
