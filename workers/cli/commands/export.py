"""Command ``octasplat export``: write a scene in other formats."""

import click

from octasplat.engine.files import exporters
from octasplat.engine.operations.export import OPERATION
from octasplat.workers.cli.request_options import operation_command


class _FormatListCommand(click.Command):
    """Lists the formats of the registry in its help."""

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the formats, one a row."""
        rows = [
            (exporter.name, f"{', '.join(exporter.patterns)}: {exporter.description}")
            for exporter in exporters()
        ]
        with formatter.section("Formats"):
            formatter.write_dl(rows)


export = operation_command(OPERATION, threads=True, cls=_FormatListCommand)
