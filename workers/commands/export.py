"""``octasplat export``: Gaussians to other formats."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from engine.gaussians.ply import ImportReport

THICK = 0.5
"""Gaussians whose thickness is more than this share of their next extent are no surfaces."""


@click.command(short_help="Gaussians to meshes and other formats.")
@click.argument("source", metavar="IN.ply", type=click.Path(path_type=Path))
@click.argument("target", metavar="OUT", type=click.Path(path_type=Path))
@click.option("--format", "format_name", metavar="NAME", help="The format, if OUT's name does not say it.")
@click.option(
    "--min-opacity", type=click.FloatRange(0, 1, max_open=True), default=0.0, help="Leave fainter ones out."
)
@click.option(
    "--sh-pad",
    type=click.IntRange(0, 3),
    help="Gaussian PLY: pad the harmonics with zeros up to this degree.",
)
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
    sh_pad: int | None,
    q: float | None,
) -> None:
    """Write the Gaussians of IN.ply, any PLY in the layout of 3DGS, to OUT in another format.

    OUT's name says the format: glb for *.glb, obj for *.obj, mesh-ply for mesh.ply and *.mesh.ply (these are
    octagon meshes), gaussians for any other *.ply.
    """
    from engine.export.options import ExportOptions
    from engine.export.registry import export_scene, exporter_for
    from engine.gaussians.octagon import CHI2_2_99
    from engine.gaussians.ply import read_gaussian_ply
    from workers.signals import orderly_termination

    exporter = exporter_for(target, format_name)  # complain before the long work
    gaussians, report = read_gaussian_ply(source)
    _tell_of_losses(source, report)
    options = ExportOptions(q=CHI2_2_99 if q is None else q, min_opacity=min_opacity, sh_pad_degree=sh_pad)
    with orderly_termination():
        files = export_scene(gaussians, target, options, exporter.name)
    for path in files:
        click.echo(f"Wrote {path} ({path.stat().st_size / 1e6:.1f} MB).")


def _tell_of_losses(source: Path, report: "ImportReport") -> None:
    if report.saturated:
        click.echo(f"{source}: {report.saturated:,} opacities of exactly 0 or 1 were made finite.", err=True)
    if not report.flattened:
        return
    loss = (
        f"{source}: {report.flattened:,} of {report.count:,} Gaussians were not flat and lost their smallest "
        f"extent, which was {report.median_thickness:.2g} of the next one in the median"
    )
    if report.median_thickness > THICK:
        loss = f"Warning: {loss}; as flat Gaussians the scene will look different."
    else:
        loss += "."
    click.echo(loss, err=True)
