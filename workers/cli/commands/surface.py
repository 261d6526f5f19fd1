"""``octasplat surface``: one colored triangle mesh of a scene."""

from octasplat.engine.operations.surface import OPERATION
from octasplat.workers.cli.request_options import operation_command

surface = operation_command(OPERATION, is_stoppable=True, threads=True)
