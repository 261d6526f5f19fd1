"""``octasplat surface``: one coloured triangle mesh of a scene."""

import re
from pathlib import Path
from typing import Any

import click

from octasplat.workers.cli.camera_options import AXES
from octasplat.workers.cli.options import quiet_option, threads_option

FACTORS = {"": 1, "k": 1000, "M": 1_000_000}


def _rim(_context: click.Context, _parameter: click.Parameter, value: str) -> float | None:
    """A number of voxels, or None for ``all``."""
    if value == "all":
        return None
    try:
        number = float(value)
    except ValueError:
        number = -1.0
    if not number >= 0:
        raise click.BadParameter(f"{value!r} is neither a number of voxels nor 'all'.")
    return number


def _box(_context: click.Context, _parameter: click.Parameter, value: str | None) -> tuple[float, ...] | None:
    """Six numbers with commas between them."""
    if value is None:
        return None
    try:
        numbers = tuple(float(part) for part in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 6:
        raise click.BadParameter(f"{value!r} is not six numbers x0,y0,z0,x1,y1,z1.")
    return numbers


def _levels(_context: click.Context, _parameter: click.Parameter, value: str | None) -> dict[str, int] | None:
    """Numbers such as 5k with commas between them, each under what was written."""
    if value is None:
        return None
    levels: dict[str, int] = {}
    for part in value.split(","):
        written = re.fullmatch(r"(\d+(?:\.\d+)?)([kM]?)", part.strip())
        count = round(float(written[1]) * FACTORS[written[2]]) if written else 0
        if not 4 <= count < 1 << 31:
            raise click.BadParameter(f"{part!r} is no number of triangles from 4 on, such as 60000 or 50k.")
        if count in levels.values():
            raise click.BadParameter(f"{part!r} is there twice.")
        levels[part.strip()] = count
    return levels


@click.command(short_help="One coloured triangle mesh of a scene.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), required=True, help="A .glb, .ply or .obj file."
)
@click.option("--unbounded", is_flag=True, help="Reach to the horizon, with ever coarser voxels.")
@click.option(
    "--bounds",
    callback=_box,
    metavar="X0,Y0,Z0,X1,Y1,Z1",
    help="The box to mesh; octasplat info tells where the scene lies.  "
    "[default: what is seen of the space that the cameras surround]",
)
@click.option("--voxel", type=click.FloatRange(0, min_open=True), help="Side of a voxel, in scene units.")
@click.option(
    "--resolution", type=click.IntRange(16, 4096), help="Voxels along the longest side.  [default: up to 512]"
)
@click.option(
    "--truncation",
    type=click.FloatRange(2, 128),
    metavar="VOXELS",
    help="Half width of the band of distances kept.  [default: 3% of the cameras' distance]",
)
@click.option("--depth-trunc", type=click.FloatRange(0, min_open=True), help="Ignore depths beyond this.")
@click.option("--depth", type=click.Choice(["median", "expected"]), help="Which depth.  [default: median]")
@click.option(
    "--depth-side",
    type=click.IntRange(16, 8192),
    metavar="PX",
    help="Longer side of the depth maps.  [default: 640]",
)
@click.option("--min-weight", type=click.FloatRange(0, min_open=True), help="Least evidence for a voxel.")
@click.option(
    "--unseen", type=click.Choice(["open", "solid"]),
    help="Space that no view saw: open leaves holes there, solid closes the mesh.  [default: open]",
)  # fmt: skip
@click.option("--backdrop", is_flag=True, help="A sphere around everything that shows what lies in gaps.")
@click.option("--settle", is_flag=True, help="Move vertices to where the pictures agree, before colours.")
@click.option(
    "--room", is_flag=True,
    help="What pictures of a room need: --unbounded --unseen solid --backdrop --settle and finer voxels.",
)  # fmt: skip
@click.option("--components", "keep_components", type=click.IntRange(1), help="Keep so many parts only.")
@click.option(
    "--min-component",
    type=click.FloatRange(0, 1),
    help="Remove parts of less than this share of the largest part's area.  [default: 0.01]",
)
@click.option(
    "--fill-holes",
    callback=_rim,
    default="0",
    metavar="VOXELS",
    help="Close holes with rims up to this; or 'all'.",
)
@click.option(
    "--max-triangles", callback=_levels, metavar="N[,N...]",
    help="Decimate to so many triangles, such as 60000 or 60k; 5k,50k,500k writes a file each, NAME_5k.glb.",
)  # fmt: skip
@click.option(
    "--texture", "texture_side", type=click.IntRange(64, 16384), metavar="PX",
    help="Colours in a square texture of this side instead of in the vertices; .glb and .obj.",
)  # fmt: skip
@click.option(
    "--materials",
    is_flag=True,
    help="Base colour, metallic, roughness and normals in textures, to be lit; .glb.",
)
@click.option(
    "--up", type=click.Choice(AXES),
    help="--materials: the axis that points up.  [default: the run's, of a file -y]",
)  # fmt: skip
@click.option("--max-memory", "max_memory_gb", type=float, metavar="GB", help="For the volume.  [default: 4]")
@click.option(
    "--scene",
    type=click.Path(path_type=Path),
    help="Take the cameras of the photographs in this folder.  [default: those a run keeps; else none]",
)
@threads_option
@quiet_option
def surface(
    source: Path,
    output: Path,
    scene: Path | None,
    materials: bool,
    room: bool,
    up: str | None,
    threads: int,
    quiet: bool,
    max_triangles: dict[str, int] | None,
    **given: Any,
) -> None:
    """Mesh IN, the folder of a run or a file of Gaussians, into one surface of coloured triangles.

    Depth is rendered from where the photographs were taken; for a file without --scene, from cameras all
    around, which suits an object but no room. The result lies in the frame of the scene.

    --materials takes 60,000 triangles and a texture of 1,024 pixels where nothing else is said. Of a run,
    environment.hdr goes beside the file.
    """
    if up and not materials:
        raise click.UsageError("--up goes with --materials.")
    from octasplat.engine.errors import Cancelled
    from octasplat.workers.cli.signals import Stopped, stop_on_signals
    from octasplat.workers.cli.surfacing import ROOM, Asked, run_surface

    # None means "all" for the holes, and the default for everything else.
    options = {
        name: value
        for name, value in given.items()
        if name == "fill_holes" or (value is not None and value is not False)
    }
    options = {**(ROOM if room else {}), **options}
    levels = max_triangles or {}
    if len(levels) == 1:
        options["max_triangles"], levels = next(iter(levels.values())), {}
    with stop_on_signals() as should_stop:
        try:
            run_surface(
                Asked(source, output, scene, materials=materials, up=up, levels=levels),
                options, threads=threads, quiet=quiet, should_stop=should_stop,
            )  # fmt: skip
        except Cancelled as error:
            raise Stopped(str(error), should_stop.exit_code) from None
