"""``octasplat render``: new views of a scene, as images or a video."""

from octasplat.engine.operations.render import OPERATION
from octasplat.workers.cli.picture_command import picture_command

render = picture_command(OPERATION, "linear RGB, alpha, depth and normals")
