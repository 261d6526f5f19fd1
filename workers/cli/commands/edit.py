"""``octasplat edit``: a scene from its edited mesh."""

from pathlib import Path

import click

from octasplat.workers.cli.options import quiet_option, report_option, scenes_output_option


@click.command(short_help="A mesh edited elsewhere back to Gaussians.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "--mesh",
    "meshes",
    multiple=True,
    required=True,
    metavar="MESH",
    help="The edited mesh (.ply, .obj or .glb), or a quoted pattern such as 'frames/*.ply' for a sequence.",
)
@scenes_output_option
@click.option(
    "--method",
    type=click.Choice(["least-squares", "three-point"]),
    default="least-squares",
    show_default=True,
    help="How a frame follows from the corners; three-point is the rule of the paper, which drops shear.",
)
@click.option(
    "--damaged",
    type=click.Choice(["repair", "drop"]),
    default="repair",
    show_default=True,
    help="What becomes of octagons that lost corners, flipped or crumpled.",
)
@click.option(
    "--axes",
    type=click.Choice(["auto", "x0", "x90", "x180", "x270"]),
    default="auto",
    show_default=True,
    help="Turn of the mesh about x, in degrees, that brings it back to the scene's axes.",
)
@click.option(
    "--q",
    type=click.FloatRange(0, 100, min_open=True),
    help="What the mesh was exported with, should it not say.",
)
@click.option(
    "--max-residual",
    type=click.FloatRange(0, min_open=True),
    help="Octagons further from an affine image than this many standard deviations are crumpled.  "
    "[default: 1]",
)
@click.option(
    "--whole-octagons",
    is_flag=True,
    help="Octagons of which only some corners moved move as a whole, or not at all if most stayed.",
)
@report_option
@quiet_option
def edit(
    source: Path,
    meshes: tuple[str, ...],
    output: Path,
    method: str,
    damaged: str,
    axes: str,
    q: float | None,
    max_residual: float | None,
    whole_octagons: bool,
    report: Path | None,
    quiet: bool,
) -> None:
    """Bring an edited mesh of the scene IN back to Gaussians.

    The mesh is what octasplat export wrote for IN, moved, bent, cut or copied in a mesh editor. Gaussians
    whose octagon stayed keep every bit. See docs/editing.md.
    """
    from octasplat.workers.cli.editing import run_edit
    from octasplat.workers.cli.signals import orderly_termination

    given = {
        "method": method,
        "damaged": damaged,
        "axes": axes,
        "q": q,
        "max_residual": max_residual,
        "whole_octagons": whole_octagons,
    }
    with orderly_termination():
        run_edit(source, meshes, output, given, report_path=report, quiet=quiet)
