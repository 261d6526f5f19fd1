"""``octasplat material``: other materials for chosen Gaussians."""

from octasplat.engine.operations.material import OPERATION
from octasplat.workers.cli.request_options import operation_command

material = operation_command(OPERATION)
