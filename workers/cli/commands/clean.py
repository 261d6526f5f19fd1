"""Command ``octasplat clean``: remove unwanted Gaussians."""

from octasplat.engine.operations.clean import OPERATION
from octasplat.workers.cli.request_options import operation_command

clean = operation_command(OPERATION)
