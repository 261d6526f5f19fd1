"""``octasplat estimate``: what a reconstruction takes."""

from octasplat.engine.operations.estimate import OPERATION
from octasplat.workers.cli.request_options import operation_command

estimate = operation_command(OPERATION)
