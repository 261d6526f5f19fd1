"""Command ``octasplat transform``: move, rotate and scale a scene."""

from octasplat.engine.operations.transform import OPERATION
from octasplat.workers.cli.request_options import operation_command

transform = operation_command(OPERATION)
