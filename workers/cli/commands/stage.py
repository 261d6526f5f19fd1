"""``octasplat stage``: stages, which put meshes and lights into a scene."""

import click

from octasplat.engine.operations.stage_init import OPERATION
from octasplat.workers.cli.request_options import operation_command


@click.group(short_help="Stages: things and lights put into a scene.")
def stage() -> None:
    """Make stages for octasplat render --stage."""


stage.add_command(operation_command(OPERATION, threads=True), "init")
