"""``octasplat evaluate``: measure a finished run again."""

from octasplat.engine.operations.evaluate import OPERATION
from octasplat.workers.cli.request_options import operation_command

evaluate = operation_command(OPERATION, threads=True)
