"""``octasplat migrate``: the tables of a database, brought to this version."""

from pathlib import Path

import click


@click.command(short_help="Bring a database to this version's tables.")
@click.option(
    "--data", type=click.Path(path_type=Path), metavar="FOLDER", help="Data folder of octasplat serve."
)
def migrate(data: Path | None) -> None:
    """Bring the tables of the database that DATABASE_URL names up to date.

    octasplat serve and the front end do so by themselves as they start; workers wait for it, and no other
    command does. Processes of the version before go on meanwhile.
    """
    from octasplat.workers.db.migrate import migrate
    from octasplat.workers.settings import WorkerSettings, load_settings

    applied = migrate(load_settings(WorkerSettings, data=data).conninfo())
    click.echo(f"Applied {', '.join(applied)}." if applied else "Nothing to do.")
