"""``octasplat plan``: the blocks of a large capture, before anything starts."""

from octasplat.engine.operations.plan import OPERATION
from octasplat.workers.cli.request_options import operation_command

plan = operation_command(OPERATION)
