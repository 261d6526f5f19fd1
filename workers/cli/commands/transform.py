"""``octasplat transform``: a scene moved, turned, scaled."""

from pathlib import Path

import click

from octasplat.workers.cli.camera_options import AXES
from octasplat.workers.cli.options import quiet_option


@click.command(short_help="Move, turn or scale a scene.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), required=True, help="The scene to write.")
@click.option(
    "--matrix",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="A text file with an affine 4 x 4 or 3 x 4 matrix, row by row, that maps old points to new ones.",
)
@click.option(
    "--up",
    nargs=2,
    type=click.Choice(AXES),
    metavar="OLD NEW",
    help="Turn the axis that points up to another, e.g. --up -y z from COLMAP's usual frame to Blender's.",
)
@click.option("--scale", type=float, help="Scale by a factor.")
@click.option(
    "--rotate",
    nargs=2,
    type=(click.Choice(["x", "y", "z"]), float),
    multiple=True,
    metavar="AXIS DEGREES",
    help="Turn about an axis, counter-clockwise seen from its tip; may be repeated.",
)
@click.option("--translate", nargs=3, type=float, metavar="X Y Z", help="Move.")
@click.option(
    "--about",
    nargs=3,
    type=float,
    metavar="X Y Z",
    help="The point that --up, --scale and --rotate leave where it is.  [default: 0 0 0]",
)
@quiet_option
def transform(
    source: Path,
    output: Path,
    matrix: Path | None,
    up: tuple[str, str] | None,
    scale: float | None,
    rotate: tuple[tuple[str, float], ...],
    translate: tuple[float, float, float] | None,
    about: tuple[float, float, float] | None,
    quiet: bool,
) -> None:
    """Move, turn, scale or shear the scene IN, its view-dependent colours included.

    Done in this order: --matrix, --up, --scale, --rotate as often as given, --translate.
    """
    if matrix is None and up is None and scale is None and not rotate and translate is None:
        raise click.UsageError("Say what to do: --matrix, --up, --scale, --rotate or --translate.")

    import numpy as np

    from octasplat.engine.edit import affine
    from octasplat.engine.files import read_facts
    from octasplat.workers.cli.editing import speaker, targets_for, write_scene
    from octasplat.workers.cli.scene_files import open_scene
    from octasplat.workers.cli.signals import orderly_termination

    (target,) = targets_for(output, [source], [source])
    turns = np.eye(4)
    if up is not None:
        turns = affine.between_axes(*up)
    if scale is not None:
        turns = affine.scaling(np.full(3, scale)) @ turns
    for axis, degrees in rotate:
        turns = affine.rotation(affine.AXES[axis], degrees) @ turns
    whole = affine.about(turns, np.array(about or (0.0, 0.0, 0.0)))
    if matrix is not None:
        whole = whole @ affine.read_matrix(matrix)
    if translate is not None:
        whole = affine.translation(np.array(translate)) @ whole
    with orderly_termination():
        moved = affine.transform(open_scene(source, quiet=quiet), whole)
        facts = read_facts(source).scaled(affine.mean_stretch(whole))
        write_scene(moved, facts, target, speaker(quiet))
