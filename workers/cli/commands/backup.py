"""``octasplat backup`` and ``octasplat restore``: a whole service in a folder, and back."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from octasplat.workers.settings import WorkerSettings

_DATA = click.option(
    "--data", type=click.Path(path_type=Path), metavar="FOLDER", help="Data folder of octasplat serve."
)


@click.command(short_help="Copy a service, tables and store, while it runs.")
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@_DATA
def backup(folder: Path, data: Path | None) -> None:
    """Copy the tables of a service, and everything in its store that they name, into FOLDER.

    The service may run meanwhile; everything is of one moment. Into the folder of an earlier backup only new
    contents are copied. Whoever can read FOLDER can read everything; of tokens it holds digests only.
    """
    from octasplat.workers.settings import WorkerSettings, load_settings
    from octasplat.workers.store.opening import open_storage
    from octasplat.workers.upkeep.backup import back_up, explained

    settings = load_settings(WorkerSettings, data=data)
    with _database(settings) as conninfo, explained():
        storage = open_storage(settings.storage_address, floor_bytes=0)
        copied = back_up(conninfo, storage, folder.absolute())
    click.echo(
        f"{copied.rows} rows and {copied.contents} contents of {copied.size_bytes} bytes are in {folder}."
    )


@click.command(short_help="Put a backup into an empty service.")
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
@_DATA
def restore(folder: Path, data: Path | None) -> None:
    """Put the backup in FOLDER into an empty database and an empty store, those of the settings.

    No service may run on them. Jobs that were queued or under way when the backup was made are queued again.
    """
    from octasplat.workers.settings import WorkerSettings, load_settings
    from octasplat.workers.store.opening import open_storage
    from octasplat.workers.upkeep.backup import explained
    from octasplat.workers.upkeep.backup import restore as put_back

    settings = load_settings(WorkerSettings, data=data)
    with _database(settings, alone=True) as conninfo, explained():
        storage = open_storage(settings.storage_address, floor_bytes=settings.floor_bytes)
        copied = put_back(conninfo, storage, folder.absolute())
    click.echo(
        f"{copied.rows} rows and {copied.contents} contents of {copied.size_bytes} bytes are restored."
    )


@contextlib.contextmanager
def _database(settings: "WorkerSettings", *, alone: bool = False) -> Iterator[str]:
    """How to connect; the private database is started for as long as the block runs if it does not run."""
    from octasplat.workers.postgres.embedded import EmbeddedPostgres
    from octasplat.workers.serve.machine import hold_data

    if settings.database_url is not None:
        yield settings.conninfo()
        return
    with hold_data(settings.data) if alone else contextlib.nullcontext():
        database = EmbeddedPostgres(settings.data.absolute())
        ran = database.is_running()
        conninfo = database.start()
        try:
            yield conninfo
        finally:
            if not ran:
                database.stop()
