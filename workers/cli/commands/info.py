"""``octasplat info``: what is in a file or a run."""

import sys
from typing import Any

import click

from octasplat.engine.operations.info import OPERATION, InfoRequest
from octasplat.workers.cli.options import threads_option
from octasplat.workers.cli.printing import Printer, output_options
from octasplat.workers.cli.request_options import request_from_options, request_options, run_operation

THUMBNAIL_COLUMNS = 60
"""Columns of the picture in a terminal."""


@click.command("info", short_help=OPERATION.title, help=InfoRequest.__doc__)
@request_options(InfoRequest)
@threads_option
@output_options
def info(printer: Printer, threads: int, **given: Any) -> None:
    """Look at a scene."""
    result = run_operation(OPERATION, request_from_options(InfoRequest, given), printer, threads=threads)
    if result.picture_srgb is not None and sys.stdout.isatty() and not printer.hides_progress:
        click.echo(_terminal_image(result.picture_srgb))


def _terminal_image(image_srgb: Any) -> str:
    """Return a picture for a terminal that shows colors: two pixels a letter, one above the other."""
    import numpy as np

    height, width = image_srgb.shape[:2]
    rows = 2 * max(1, round(THUMBNAIL_COLUMNS * height / width / 2))
    y = (np.arange(rows) + 0.5) * height // rows
    x = (np.arange(THUMBNAIL_COLUMNS) + 0.5) * width // THUMBNAIL_COLUMNS
    pixels = (255 * image_srgb[y.astype(int)][:, x.astype(int)]).astype(int)
    lines = []
    for upper, lower in zip(pixels[::2], pixels[1::2], strict=True):
        letters = (
            f"\x1b[38;2;{a[0]};{a[1]};{a[2]};48;2;{b[0]};{b[1]};{b[2]}m\u2580"
            for a, b in zip(upper, lower, strict=True)
        )
        lines.append("".join(letters) + "\x1b[0m")
    return "\n".join(lines)
