"""``octasplat material``: other materials for chosen Gaussians."""

from pathlib import Path
from typing import Any

import click

from octasplat.workers.cli.options import quiet_option, selection_options


@click.command(short_help="Change the materials of a scene.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    required=True,
    help="A folder for all of the run with its new scene, or a file for the scene alone.",
)
@click.option(
    "--set",
    "values",
    multiple=True,
    metavar="NAME=VALUE",
    help="albedo=R,G,B (linear, 0 to 1), albedo=#rrggbb (display), metallic=0..1 or roughness=0..1.",
)
@click.option(
    "--scale",
    "factors",
    multiple=True,
    metavar="NAME=FACTOR",
    help="Multiply albedo, metallic or roughness; 1 is the most that comes out.",
)
@selection_options
@click.option(
    "--mesh",
    type=click.Path(path_type=Path),
    metavar="MESH",
    help="Those whose octagons are in this mesh: IN's mesh.ply after the rest was deleted in an editor.",
)
@click.option(
    "--mask",
    "masks",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="IMAGE",
    help="Those that show where this image is white; it has the name of one of the run's photographs. "
    "Several say together what is meant.",
)
@quiet_option
def material(**options: Any) -> None:
    """Change the materials of IN, the folder of a run with materials or a file of Gaussians that has them.

    Without a choice all Gaussians are changed; of several choices all must hold. For example:
    octasplat material OUT --set roughness=0.3 --where "metallic > 0.5" -o OUT2
    """
    from octasplat.workers.cli.materials import run_material
    from octasplat.workers.cli.signals import orderly_termination

    with orderly_termination():
        run_material(options)
