"""``octasplat crop``: part of a scene."""

from octasplat.engine.operations.crop import OPERATION
from octasplat.workers.cli.request_options import operation_command

crop = operation_command(OPERATION)
