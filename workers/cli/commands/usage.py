"""``octasplat usage``: what one has stored in a service, and what one may."""

import click

from octasplat.engine.core.durations import format_duration
from octasplat.workers.cli.printing import Printer, output_options
from octasplat.workers.cli.service_options import connected, server_option


@click.command(short_help="Show what you have stored and what you may.")
@server_option
@output_options
def usage(server: str | None, printer: Printer) -> None:
    """Show what your token's owner has stored and asked for, and how much is allowed."""
    with connected(server) as api:
        found = api.get("/v1/usage")
    lines = [f"Owner: {found['owner']}"]
    for name, text in (("bytes", "bytes"), ("datasets", "datasets"), ("jobs", "unfinished jobs")):
        limit = found[name]["limit"]
        lines.append(f"{text}: {found[name]['used']} of {'any number' if limit is None else limit}")
    lines.append(f"time of jobs: {format_duration(found['job_seconds'])}")
    printer.print(found, lines)
