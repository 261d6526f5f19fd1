"""The way of a user through the service, on a scene that octasplat makes itself."""

import os
from pathlib import Path

import click

from workers.client.api import TOKEN, Api
from workers.client.submission import Submission, submit_and_wait

OUTPUT = Path("octasplat-demo")


def run_demo(address: str, output: Path = OUTPUT) -> None:
    """Make the generated scene, submit it, wait, save the results and name the report.

    Args:
        address: of the service.
        output: folder for the scene and the result.
    """
    from workers.cli.demonstration import make_scene

    scene = output / "scene"
    make_scene(scene, {}, quiet=False)
    options = {"preset": "fast", "train": {"iterations": 2000}}
    with Api(address, os.environ.get(TOKEN)) as api:
        submit_and_wait(api, Submission(scene, options=options, label="demo"), output / "result")
    click.echo(f"Open {output / 'result' / 'report.html'} in a browser to see the result.")
