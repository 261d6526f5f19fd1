"""``octasplat render``: new views of a scene, as images or a video."""

from octasplat.engine.operations.render import OPERATION
from octasplat.workers.cli.render_command import render_command

render = render_command(OPERATION, "linear RGB, alpha, depth and normals")
