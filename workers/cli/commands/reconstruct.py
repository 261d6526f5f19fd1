"""``octasplat reconstruct``: the main job."""

from typing import Any

import click

from octasplat.engine.operations.reconstruct import OPERATION, ReconstructRequest
from octasplat.workers.cli.options import threads_option
from octasplat.workers.cli.printing import Printer, output_options
from octasplat.workers.cli.request_options import request_from_options, request_options


@click.command(short_help=OPERATION.title, help=ReconstructRequest.__doc__)
@request_options(ReconstructRequest)
@threads_option
@output_options
def reconstruct(threads: int, printer: Printer, **given: Any) -> None:
    """Reconstruct a scene; the text of the request is the help."""
    from octasplat.workers.cli.reconstruction import run_reconstruction

    run_reconstruction(request_from_options(ReconstructRequest, given), printer, threads=threads)
