"""``octasplat export``: Gaussians to other formats."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from octasplat.workers.cli.camera_options import AXES
from octasplat.workers.cli.options import quiet_option

if TYPE_CHECKING:
    from octasplat.engine.files import ExportOptions
    from octasplat.engine.gaussians.model import FlatGaussians


CORES_OF_CHUNKS, CORES_IN_ORDER = 0.3, 0.5
"""Where ``--for-viewers`` draws solid, in chunks and in one order (docs/opening/threejs.md)."""


class _ExportCommand(click.Command):
    """Lists the formats of the registry in its help; it is loaded only then."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the formats, one a row."""
        from octasplat.engine.files import exporters

        rows = [
            (exporter.name, f"{', '.join(exporter.patterns)}: {exporter.description}")
            for exporter in exporters()
        ]
        with formatter.section("Formats"):
            formatter.write_dl(rows)


@click.command(cls=_ExportCommand, short_help="Gaussians to meshes and other formats.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.argument("target", metavar="OUT", type=click.Path(path_type=Path))
@click.option("--format", "format_name", metavar="NAME", help="The format, if OUT's name does not say it.")
@click.option(
    "--min-opacity", type=click.FloatRange(0, 1, max_open=True), default=0.0, help="Leave fainter ones out."
)
@click.option(
    "--colour",
    metavar="cameras|constant|X,Y,Z",
    help="Formats with one colour for each Gaussian: the one that loses least seen from the photographs' "
    "places of a run, or from all around a file; the harmonics' constant part; or the one seen along a "
    "direction.  [default: cameras for a run, constant for a file]",
)
@click.option(
    "--sh-pad",
    type=click.IntRange(0, 3),
    help="Gaussian PLY: pad the harmonics with zeros up to this degree.",
)
@click.option(
    "--spz-version",
    type=click.Choice(["3", "4"]),
    default="3",
    show_default=True,
    help="SPZ: 3, which every viewer reads, or 4.",
)
@click.option(
    "--opaque",
    is_flag=True,
    help="GLB: cut alpha at a threshold instead of blending, for programs that cannot sort.",
)
@click.option(
    "--for-viewers",
    is_flag=True,
    help="GLB: for programs that sort chunks at best: solid middles beneath, and in a run whose photographs "
    "were taken from one side, the order that is right from most of them. Carries no numbers for edits.",
)
@click.option(
    "--materials",
    is_flag=True,
    help="GLB: base colour, metallic and roughness instead of colours that have their light in them.",
)
@click.option(
    "--up",
    type=click.Choice(AXES),
    help="--materials: the axis that points up.  [default: the run's, of a file -y]",
)
@click.option(
    "--chunks",
    type=click.IntRange(1, 4096),
    default=64,
    show_default=True,
    help="GLB: most spatial chunks, which programs sort by distance; rounded down to a power of two.",
)
@click.option(
    "--texture",
    "texture_size",
    type=click.IntRange(8, 4096),
    default=128,
    show_default=True,
    metavar="PX",
    help="GLB, OBJ: side of the texture that holds the fall-off.",
)
@click.option("--no-ids", is_flag=True, help="GLB: leave out the numbers by which edits find back.")
@quiet_option
@click.option(
    "--q",
    type=click.FloatRange(0, 100, min_open=True),
    help="Meshes: squared radius of the octagons in standard deviations.  [default: 9.21]",
)
def export(
    source: Path,
    target: Path,
    format_name: str | None,
    min_opacity: float,
    colour: str | None,
    sh_pad: int | None,
    spz_version: str,
    opaque: bool,
    for_viewers: bool,
    materials: bool,
    up: str | None,
    chunks: int,
    texture_size: int,
    no_ids: bool,
    q: float | None,
    quiet: bool,
) -> None:
    """Write the Gaussians of IN, the folder of a run or a file of any splat format, to OUT in another format.

    OUT's name says the format, unless --format does; the formats are listed below. Where two take a name, as
    *.ply and *.mesh.ply do, the longer pattern wins.
    """
    if up and not materials:
        raise click.UsageError("--up goes with --materials.")
    from octasplat.engine.files import ExportOptions, export_scene, exporter_for, read_facts
    from octasplat.engine.gaussians.materials import require_materials
    from octasplat.engine.gaussians.octagon import CHI2_2_99
    from octasplat.engine.operations.axes import light_up
    from octasplat.workers.cli.scene_files import open_scene, warn_of_losses
    from octasplat.workers.cli.signals import orderly_termination

    exporter = exporter_for(target, format_name)  # complain before the long work
    if opaque and exporter.name != "glb":
        raise click.UsageError(f"--opaque is for GLB; {target} is written as {exporter.name}.")
    if materials and exporter.name != "glb":
        raise click.UsageError(f"--materials is for octagon GLB; {target} is written as {exporter.name}.")
    if for_viewers and (exporter.name != "glb" or opaque or materials):
        raise click.UsageError("--for-viewers is for octagon GLB, without --opaque and --materials.")
    chosen = _colour(colour, source)
    gaussians = open_scene(source, quiet=quiet)
    light = None
    if materials:
        require_materials(gaussians, source)
        x, y, z = light_up(source, up).tolist()
        light = (x, y, z)
    options = ExportOptions(
        q=CHI2_2_99 if q is None else q,
        min_opacity=min_opacity,
        sh_pad_degree=sh_pad,
        opaque=opaque,
        chunks=chunks,
        texture_size=texture_size,
        ids=not (no_ids or for_viewers),
        cores=CORES_OF_CHUNKS if for_viewers else None,
        light_up=light,
        facts=read_facts(source),
        spz_version=4 if spz_version == "4" else 3,
    )
    if not materials:
        warn_of_losses(gaussians, target, exporter.name)
    with orderly_termination():
        if not (exporter.holds_harmonics or materials):
            gaussians = _one_colour(gaussians, source, chosen)
        if for_viewers:
            gaussians, options = _drawn_in_order(gaussians, source, options)
        files = export_scene(gaussians, target, options, exporter.name)
    for path in () if quiet else files:
        click.echo(f"Wrote {path} ({path.stat().st_size / 1e6:.1f} MB).")


def _drawn_in_order(
    gaussians: "FlatGaussians", source: Path, options: "ExportOptions"
) -> "tuple[FlatGaussians, ExportOptions]":
    """In one chunk and in the order of most photographs' cameras, where these agree; else as it was."""
    import numpy as np

    from octasplat.engine.render.draw_order import AGREEMENT, common_order
    from octasplat.engine.run_folder import CONFIG, is_run, run_viewpoints

    if not (is_run(source) and (source / CONFIG).exists()):
        return gaussians, options
    seen = run_viewpoints(source)
    centres = np.stack([seen.views[index].origin_world for index in seen.train_indices])
    order, agreement = common_order(gaussians.means_world, centres)
    if agreement < AGREEMENT:
        return gaussians, options
    return gaussians.select(order), options.model_copy(update={"chunks": 1, "cores": CORES_IN_ORDER})


def _colour(text: str | None, source: Path) -> "str | tuple[float, float, float]":
    """What ``--colour`` says: ``cameras``, ``constant``, or a direction."""
    from octasplat.engine.run_folder import is_run

    if text is None:
        return "cameras" if is_run(source) else "constant"
    if text in ("cameras", "constant"):
        return text
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        raise click.UsageError(f"--colour {text}: write cameras, constant, or three numbers X,Y,Z.") from None
    if not 0 < math.hypot(x, y, z) < math.inf:
        raise click.UsageError(f"--colour {text}: is no direction.")
    return x, y, z


def _one_colour(
    gaussians: "FlatGaussians", source: Path, colour: "str | tuple[float, float, float]"
) -> "FlatGaussians":
    import numpy as np

    from octasplat.engine.plain_colours import PlainScene
    from octasplat.engine.render.one_colour import colours_toward, with_colours
    from octasplat.engine.run_folder import is_run

    if colour == "constant" or gaussians.sh_degree == 0:
        return gaussians
    if colour == "cameras":
        run = source if is_run(source) else None
        return PlainScene(
            gaussians, run, on_unknown=lambda text: click.echo(f"Warning: {text}", err=True)
        ).gaussians
    return with_colours(gaussians, colours_toward(gaussians, np.array(colour)))
