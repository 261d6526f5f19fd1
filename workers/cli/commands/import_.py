"""``octasplat import``: scenes of other programs to our own PLY."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from octasplat.workers.cli.options import quiet_option

if TYPE_CHECKING:
    from octasplat.engine.files import ChannelChoice
    from octasplat.engine.gaussians.flattening import ImportReport


@click.command("import", short_help="Splats of any format to a scene of flat Gaussians.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.argument("target", metavar="OUT.ply", type=click.Path(path_type=Path))
@click.option("--format", "format_name", metavar="NAME", help="The format, if IN does not show it.")
@click.option(
    "--drop-invalid", is_flag=True, help="Leave out Gaussians with values that are not finite numbers."
)
@click.option(
    "--sh-degree", type=click.IntRange(0, 3), help="Keep the spherical harmonics up to this degree only."
)
@click.option(
    "--channels",
    metavar="NAMES",
    default="",
    help="Further numbers of each Gaussian to keep, as albedo,metallic; all for whatever is there.  "
    "[default: those that octasplat wrote]",
)
@quiet_option
def import_(
    source: Path,
    target: Path,
    format_name: str | None,
    drop_invalid: bool,
    sh_degree: int | None,
    channels: str,
    quiet: bool,
) -> None:
    """Read IN, a scene of Gaussians in any known format, and write OUT.ply in the layout of 3DGS.

    Formats: 3DGS PLY, compressed PLY (PlayCanvas, SuperSplat), .splat, .spz, .sog or the folder of one, and
    .glb with KHR_gaussian_splatting. A Gaussian with three extents loses the smallest; what that means for
    the scene is told. All other commands read the same formats.
    """
    from octasplat.engine.files import read_facts, read_scene
    from octasplat.engine.files.gaussian_ply import write_gaussian_ply
    from octasplat.workers.cli.progress import show_progress
    from octasplat.workers.cli.signals import orderly_termination
    from octasplat.workers.telling.losses import losses

    if target.suffix.lower() != ".ply":
        raise click.UsageError(f"{target} should end in .ply; octasplat export writes the other formats.")
    with orderly_termination(), show_progress(quiet=quiet) as listener:
        gaussians, report = read_scene(
            source, format_name, drop_invalid=drop_invalid, channels=_choice(channels), listener=listener
        )
        for line in losses(source, report):
            if not quiet or line.startswith("Warning"):
                click.echo(line, err=True)
        if sh_degree is not None and sh_degree < gaussians.sh_degree:
            gaussians.sh = gaussians.sh[:, : (sh_degree + 1) ** 2].copy()
        write_gaussian_ply(gaussians, target, facts=read_facts(source))
    if not quiet:
        for line in _summary(report):
            click.echo(line)
        if gaussians.channels:
            click.echo(f"Channels: {', '.join(gaussians.channels)}.")
        click.echo(f"Wrote {target} ({target.stat().st_size / 1e6:.1f} MB).")


def _choice(channels: str) -> "ChannelChoice":
    if channels in ("", "all"):
        return "all" if channels else "own"
    return tuple(name.strip() for name in channels.split(","))


def _summary(report: "ImportReport") -> tuple[str, ...]:
    lines = [f"{report.count:,} Gaussians with spherical harmonics of degree {report.sh_degree}."]
    if report.flattened:
        lines.append(
            f"Thickness of these, over their next extent: {report.median_thickness:.3f} in the median, "
            f"{report.max_thickness:.3f} at most, above one half in {report.thick:,} "
            f"({report.thick / report.count:.1%})."
        )
    else:
        lines.append("All of them were flat already.")
    if report.dropped:
        lines.append(f"Left out: {report.dropped:,}.")
    return tuple(lines)
