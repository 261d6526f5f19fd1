"""Commands that make pictures: their request, and flags that stand for a mode or a format."""

from typing import Any

import click

from octasplat.engine.operations.base import Operation
from octasplat.workers.cli.options import threads_option
from octasplat.workers.cli.printing import Printer, output_options
from octasplat.workers.cli.request_options import request_from_options, request_options, run_operation

_CAMERA_FIELDS = ("views", "photographs", "other_dataset", "path_file", "camera")
"""Fields of requests that say which cameras there are."""


def render_command(operation: Operation[Any, Any], exr_channels: str) -> click.Command:
    """Return the command of an operation that makes pictures.

    Args:
        operation: the verb.
        exr_channels: what EXR files of it have.
    """

    @click.command(operation.name, short_help=operation.title, help=operation.request.__doc__)
    @click.option("--turntable", is_flag=True, help="Render one turn round the scene.")
    @click.option("--exr", is_flag=True, help=f"Write EXR files with {exr_channels} instead of PNG files.")
    @request_options(operation.request)
    @threads_option
    @output_options
    def command(turntable: bool, exr: bool, threads: int, printer: Printer, **given: Any) -> None:
        if turntable:
            if any(given.get(name) for name in _CAMERA_FIELDS):
                raise click.UsageError("Choose one of --turntable and other cameras.")
            given["mode"] = "turntable"
        if exr:
            given["format"] = "exr"
        request = request_from_options(operation.request, given)
        run_operation(operation, request, printer, threads=threads, is_stoppable=True)

    return command
