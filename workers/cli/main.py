"""The command ``octasplat``: photographs to scenes, meshes, measurements and new views.

Everything heavy is imported by the commands when they run, so that ``--help`` answers at once.
"""

import errno
import os
import traceback
from typing import Any, NoReturn

import click

from octasplat.engine import __version__
from octasplat.engine.errors import OctasplatError
from octasplat.workers.cli.commands.backup import backup, restore
from octasplat.workers.cli.commands.clean import clean
from octasplat.workers.cli.commands.client import COMMANDS as CLIENT_COMMANDS
from octasplat.workers.cli.commands.crop import crop
from octasplat.workers.cli.commands.deform import deform
from octasplat.workers.cli.commands.demo import demo
from octasplat.workers.cli.commands.edit import edit
from octasplat.workers.cli.commands.evaluate import evaluate
from octasplat.workers.cli.commands.export import export
from octasplat.workers.cli.commands.fsck import fsck
from octasplat.workers.cli.commands.import_ import import_
from octasplat.workers.cli.commands.info import info
from octasplat.workers.cli.commands.material import material
from octasplat.workers.cli.commands.merge import merge
from octasplat.workers.cli.commands.migrate import migrate
from octasplat.workers.cli.commands.open import open_page
from octasplat.workers.cli.commands.quota import quota
from octasplat.workers.cli.commands.reconstruct import reconstruct
from octasplat.workers.cli.commands.relight import relight
from octasplat.workers.cli.commands.render import render
from octasplat.workers.cli.commands.serve import serve
from octasplat.workers.cli.commands.stage import stage
from octasplat.workers.cli.commands.surface import surface
from octasplat.workers.cli.commands.token import token
from octasplat.workers.cli.commands.transform import transform
from octasplat.workers.cli.commands.worker import worker
from octasplat.workers.cli.signals import Stopped

# Threads that wait for each other sleep instead of spinning: no slower alone, several times faster on a
# shared machine. Must be set before OpenMP is loaded; an explicit setting wins.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

DEBUG = "OCTASPLAT_DEBUG"
EXIT_UNEXPECTED = 70
EXIT_INTERRUPTED = 130


class _Commands(click.Group):
    """A group whose commands end with one sentence and an exit code, never with a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, click.exceptions.Exit, click.Abort):
            raise
        except Stopped as error:
            click.echo(str(error), err=True)
            ctx.exit(error.exit_code)
        except OctasplatError as error:
            _fail(ctx, str(error), 1)
        except KeyboardInterrupt:
            _fail(ctx, "Interrupted.", EXIT_INTERRUPTED)
        except Exception as error:
            if isinstance(error, OSError) and error.errno == errno.EPIPE:
                raise  # whoever read the output has left, which click treats well
            if os.environ.get(DEBUG) == "1":
                traceback.print_exc()
            text = f"{type(error).__name__}: {error} (unexpected; run with {DEBUG}=1 for details)"
            _fail(ctx, text, EXIT_UNEXPECTED)


def _fail(ctx: click.Context, message: str, exit_code: int) -> NoReturn:
    """End the program with one line on stderr."""
    click.echo(f"Error: {' '.join(message.split())}", err=True)
    ctx.exit(exit_code)


@click.group(
    cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100}
)
@click.version_option(__version__, "--version", prog_name="octasplat")
def cli() -> None:
    """Reconstruct scenes of flat Gaussians from photographs with COLMAP poses, on an ordinary CPU.

    Try it without photographs: octasplat demo
    """


for _command in (
    reconstruct, evaluate, info, export, import_, render, relight, stage, surface,
    material, edit, deform, transform, crop, merge, clean, demo, backup, restore,
    serve, worker, open_page, token, fsck, quota, migrate, *CLIENT_COMMANDS,
):  # fmt: skip
    cli.add_command(_command)


def main() -> None:
    """Entry point of ``octasplat``."""
    cli(prog_name="octasplat")
