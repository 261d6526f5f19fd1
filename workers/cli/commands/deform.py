"""``octasplat deform``: a scene that follows a coarse mesh."""

from pathlib import Path

import click

from octasplat.workers.cli.options import quiet_option, report_option, scenes_output_option


@click.command(short_help="A scene that follows a deformed cage or coarse mesh.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "--proxy",
    type=click.Path(path_type=Path),
    required=True,
    help="The mesh at rest (.ply, .obj or .glb), lying on or around what is to move.",
)
@click.option(
    "--deformed",
    multiple=True,
    required=True,
    metavar="MESH",
    help="The same mesh deformed, or a quoted pattern such as 'frames/*.obj' for a sequence.",
)
@scenes_output_option
@click.option(
    "--method",
    type=click.Choice(["nearest", "mvc"]),
    default="nearest",
    show_default=True,
    help="nearest: follow the triangles close by; mvc: mean-value coordinates of a closed cage.",
)
@click.option(
    "--reach",
    type=click.FloatRange(0),
    metavar="LENGTH",
    help="Follow fully up to this distance from the mesh, and not at all beyond twice of it; inf for "
    "everything.  [default: nearest: a tenth of the mesh's diagonal; mvc: inside of the cage]",
)
@click.option(
    "--axes",
    type=click.Choice(["x0", "x90", "x180", "x270"]),
    default="x0",
    show_default=True,
    help="Turn of both meshes about x, in degrees, that brings them to the scene's axes; x90 for what "
    "Blender saves as OBJ or GLB beside a scene imported as PLY.",
)
@click.option(
    "--mirrored",
    type=click.Choice(["auto", "yes", "no"]),
    default="auto",
    show_default=True,
    help="Whether the deformed mesh was mirrored; auto looks at it, which a flat mesh cannot show.",
)
@report_option
@quiet_option
def deform(
    source: Path,
    proxy: Path,
    deformed: tuple[str, ...],
    output: Path,
    method: str,
    reach: float | None,
    axes: str,
    mirrored: str,
    report: Path | None,
    quiet: bool,
) -> None:
    """Let the scene IN follow a coarse mesh, as an artist or a physics engine deformed it."""
    from octasplat.workers.cli.editing import run_deform
    from octasplat.workers.cli.signals import orderly_termination

    with orderly_termination():
        run_deform(
            source,
            proxy,
            deformed,
            output,
            method=method,
            reach=reach,
            axes=axes,
            mirrored={"auto": None, "yes": True, "no": False}[mirrored],
            report_path=report,
            quiet=quiet,
        )
