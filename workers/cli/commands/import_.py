"""Command ``octasplat import``: read a scene from other formats."""

from octasplat.engine.operations.import_ import OPERATION
from octasplat.workers.cli.request_options import operation_command

import_ = operation_command(OPERATION)
