"""``octasplat info``: what is in a file or a run."""

import json
import sys
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octasplat.workers.cli.camera_options import AXES
from octasplat.workers.cli.options import threads_option

if TYPE_CHECKING:
    from octasplat.engine.operations.scene_inspection import Found

BAR = 24
WIDTH = 60
"""Columns of the picture in a terminal."""


@click.command(short_help="What is in a scene: counts, bounds, sizes, cost.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option("--up", type=click.Choice(AXES), help="The axis of a file that points up.  [default: -y]")
@click.option(
    "--scene",
    type=click.Path(path_type=Path),
    help="Take the cameras of the photographs in this folder.  [default: those the run keeps]",
)
@click.option("--picture", type=click.Path(path_type=Path), metavar="FILE.png", help="Write a picture, too.")
@click.option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
@threads_option
def info(
    source: Path, up: str | None, scene: Path | None, picture: Path | None, as_json: bool, threads: int
) -> None:
    """Tell what is in IN, the folder of a run or a file of Gaussians in any splat format.

    Counts, bounds, the direction that is up, harmonics, opacities, sizes, memory, and how many Gaussians a
    ray meets. On a terminal it shows a small picture.
    """
    from octasplat.engine.operations.axes import axis_named
    from octasplat.engine.operations.render_source import open_stage_scene
    from octasplat.engine.operations.scene_inspection import find_facts
    from octasplat.engine.render.images import write_png
    from octasplat.workers.cli.progress import show_progress

    with show_progress(quiet=as_json) as progress:
        opened = open_stage_scene(source, progress, dataset=scene, threads=threads)
    found = find_facts(opened, None if up is None else axis_named(up))
    if picture is not None:
        write_png(picture, found.picture_srgb)
    if as_json:
        click.echo(json.dumps(_as_json(source, found), indent=2))
        return
    for line in _lines(source, found):
        click.echo(line)
    if sys.stdout.isatty():
        click.echo(_drawn(found.picture_srgb))


def _as_json(source: Path, found: "Found") -> dict[str, Any]:
    from octasplat.engine.evaluate.scene_facts import OPACITY_EDGES, QUANTILES

    facts = asdict(found.scene)
    facts["seen"] = {
        name: value.tolist() if hasattr(value, "tolist") else value for name, value in facts["seen"].items()
    }
    return {
        "source": str(source),
        "photographs": found.photographs,
        "up_world": found.up_world.tolist(),
        **facts,
        "opacity_edges": OPACITY_EDGES,
        "scale_quantiles_of": QUANTILES,
        "hits": asdict(found.hits),
    }


def _lines(source: Path, found: "Found") -> list[str]:
    from octasplat.engine.evaluate.scene_facts import OPACITY_EDGES

    scene = found.scene
    size = source.stat().st_size if source.is_file() else 0
    channels = ", ".join(f"{name} ({width})" for name, width in scene.channels.items())
    up = "of the photographs" if found.photographs else "as most files have it; --up says otherwise"
    quantiles = " / ".join(f"{value:.3g}" for value in scene.scale_quantiles)
    lines = [
        f"{source}: {scene.count:,} Gaussians"
        + (f", {size / 1e6:.1f} MB" if size else "")
        + (f", a run of {found.photographs} photographs" if found.photographs else ""),
        f"  memory      {scene.megabytes:.1f} MB, harmonics of degree {scene.sh_degree}"
        + (f", channels {channels}" if channels else ""),
        f"  up          {_vector(found.up_world)} ({up})",
        f"  centres     {_vector(scene.box.low_world)} to {_vector(scene.box.high_world)}",
        f"  solid part  {_vector(scene.box_solid.low_world)} to {_vector(scene.box_solid.high_world)}",
        f"  seen        around {_vector(scene.seen.centre_world)}, {2 * scene.seen.half_height:.3g} high, "
        f"{2 * scene.seen.radius:.3g} across",
        f"  size        {quantiles} (larger deviation; 1, 10, 50, 90, 99 in 100)",
        f"  shape       {scene.flatness_median:.2g} (smaller over larger deviation, median)",
        f"  hits a ray  {found.hits.mean:.0f}, of one in 20 more than {found.hits.p95:.0f}; "
        f"{100 * found.hits.share:.0f} % of the picture's rays meet any",
        "  opacity",
    ]
    most = max(scene.opacity_counts)
    for (low, high), count in zip(pairwise(OPACITY_EDGES), scene.opacity_counts, strict=True):
        bar = "#" * round(BAR * count / most)
        lines.append(f"    {low:4.2f} to {high:4.2f}  {bar:<{BAR}}  {count:,}")
    return lines


def _vector(values: Any) -> str:
    return " ".join(f"{value:.4g}" for value in values)


def _drawn(picture_srgb: Any) -> str:
    """A picture in a terminal that shows colours: two pixels a letter, one above the other."""
    import numpy as np

    height, width = picture_srgb.shape[:2]
    rows = 2 * max(1, round(WIDTH * height / width / 2))
    y = (np.arange(rows) + 0.5) * height // rows
    x = (np.arange(WIDTH) + 0.5) * width // WIDTH
    pixels = (255 * picture_srgb[y.astype(int)][:, x.astype(int)]).astype(int)
    lines = []
    for upper, lower in zip(pixels[::2], pixels[1::2], strict=True):
        letters = (
            f"\x1b[38;2;{a[0]};{a[1]};{a[2]};48;2;{b[0]};{b[1]};{b[2]}m\u2580"
            for a, b in zip(upper, lower, strict=True)
        )
        lines.append("".join(letters) + "\x1b[0m")
    return "\n".join(lines)
