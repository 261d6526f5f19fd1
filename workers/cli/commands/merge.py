"""Command ``octasplat merge``: merge scenes into one."""

from octasplat.engine.operations.merge import OPERATION
from octasplat.workers.cli.request_options import operation_command

merge = operation_command(OPERATION)
