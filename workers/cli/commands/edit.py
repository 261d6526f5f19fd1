"""Command ``octasplat edit``: convert edited meshes to scenes."""

from octasplat.engine.operations.edit import OPERATION
from octasplat.workers.cli.request_options import operation_command

edit = operation_command(OPERATION)
