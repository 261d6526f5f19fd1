"""``octasplat edit``."""

from octasplat.engine.operations.edit import OPERATION
from octasplat.workers.cli.request_options import operation_command

edit = operation_command(OPERATION)
