"""``octasplat simplify``: a scene with fewer Gaussians."""

from octasplat.engine.operations.simplify import OPERATION
from octasplat.workers.cli.request_options import operation_command

simplify = operation_command(OPERATION)
