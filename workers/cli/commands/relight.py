"""``octasplat relight``: a scene with materials in other light."""

from octasplat.engine.operations.relight import OPERATION
from octasplat.workers.cli.render_command import render_command

relight = render_command(OPERATION, "linear RGB and alpha")
