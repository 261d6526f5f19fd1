"""``octasplat stage``: stages, in which things and lights are put into a scene."""

from pathlib import Path

import click

from octasplat.workers.cli.camera_options import AXES
from octasplat.workers.cli.options import quiet_option


@click.group(short_help="Stages: things and lights put into a scene.")
def stage() -> None:
    """Make stages for octasplat render --stage."""


@stage.command(short_help="A commented stage that fits a scene.")
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), required=True, help="The TOML file to write."
)
@click.option("--up", type=click.Choice(AXES), help="Of a file: the axis that points up.  [default: -y]")
@click.option("--scene", type=click.Path(path_type=Path), help="Where the run's photographs are now.")
@quiet_option
def init(source: Path, output: Path, up: str | None, scene: Path | None, quiet: bool) -> None:
    """Write a stage that fits IN, the folder of a run or a file of Gaussians, to start from.

    It knows what is up, has a glass ball on what seems to be the floor, and a light from where the scene's
    own seems to come. What else there is stands in it as comments.
    """
    from octasplat.workers.cli.scene_files import speaker_of_losses
    from octasplat.workers.cli.signals import orderly_termination
    from octasplat.workers.rendering.stages import first_stage
    from octasplat.workers.rendering.views import stage_place

    with orderly_termination():
        place, axis = stage_place(source, scene, up, speaker_of_losses(quiet))
        facts = first_stage(place, axis, output)
    if not quiet:
        click.echo(f"Wrote {output}; up is {' '.join(f'{x:.3g}' for x in facts.up)}.")
