"""``octasplat relight``: a scene with materials in other light."""

from octasplat.engine.operations.relight import OPERATION
from octasplat.workers.cli.picture_command import picture_command

relight = picture_command(OPERATION, "linear RGB and alpha")
