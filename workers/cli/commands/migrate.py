"""``octasplat migrate``: the tables of a database, brought to this version."""

from pathlib import Path

import click

from octasplat.workers.cli.printing import Printer, output_options


@click.command(short_help="Bring a database to this version's tables.")
@click.option(
    "--data", type=click.Path(path_type=Path), metavar="FOLDER", help="Data folder of octasplat serve."
)
@output_options
def migrate(data: Path | None, printer: Printer) -> None:
    """Bring the tables of the database that DATABASE_URL names up to date.

    octasplat serve and the front end do so by themselves as they start; workers wait for it, and no other
    command does. Processes of the version before go on meanwhile.
    """
    from octasplat.workers.db.migrate import migrate
    from octasplat.workers.settings import WorkerSettings, load_settings

    applied = migrate(load_settings(WorkerSettings, data=data).conninfo())
    printer.print({"applied": applied}, [f"Applied {', '.join(applied)}." if applied else "Nothing to do."])
