"""Command ``octasplat deform``: deform a scene with a mesh."""

from octasplat.engine.operations.deform import OPERATION
from octasplat.workers.cli.request_options import operation_command

deform = operation_command(OPERATION)
