"""``octasplat backup`` and ``octasplat restore``: a whole service in a folder, and back."""

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from octasplat.engine.core.errors import OctasplatError
from octasplat.workers.cli.printing import Printer, output_options

if TYPE_CHECKING:
    from octasplat.workers.settings import WorkerSettings

_data_option = click.option(
    "--data", type=click.Path(path_type=Path), metavar="FOLDER", help="Data folder of octasplat serve."
)


@click.command(short_help="Copy a service, tables and store, while it runs.")
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False))
@_data_option
@output_options
def backup(folder: Path, data: Path | None, printer: Printer) -> None:
    """Copy the tables of a service, and everything in its store that they name, into FOLDER.

    The service may run meanwhile; everything is of one moment. Into the folder of an earlier backup only new
    contents are copied. What is damaged or missing in the store is named and left out, and the exit status is
    not zero. Whoever can read FOLDER can read everything; of tokens it holds digests only.
    """
    from octasplat.workers.maintenance.backup import create_backup, translate_database_errors
    from octasplat.workers.settings import WorkerSettings, load_settings
    from octasplat.workers.storage.factory import open_storage

    settings = load_settings(WorkerSettings, data=data)
    with _database_connection(settings) as conninfo, translate_database_errors():
        storage = open_storage(settings.storage_address, floor_bytes=0)
        copied = create_backup(conninfo, storage, folder.absolute())
    printer.print(
        copied,
        [f"{copied.rows} rows and {copied.contents} contents of {copied.size_bytes} bytes are in {folder}."],
    )
    _report_damage(copied.damaged)


@click.command(short_help="Put a backup into an empty service.")
@click.argument("folder", type=click.Path(path_type=Path, exists=True, file_okay=False))
@_data_option
@output_options
def restore(folder: Path, data: Path | None, printer: Printer) -> None:
    """Put the backup in FOLDER into an empty database and an empty store, those of the settings.

    No service may run on them. Jobs that were queued or under way when the backup was made are queued again.
    """
    from octasplat.workers.maintenance.backup import restore_backup as put_back
    from octasplat.workers.maintenance.backup import translate_database_errors
    from octasplat.workers.settings import WorkerSettings, load_settings
    from octasplat.workers.storage.factory import open_storage

    settings = load_settings(WorkerSettings, data=data)
    with _database_connection(settings, exclusive=True) as conninfo, translate_database_errors():
        storage = open_storage(settings.storage_address, floor_bytes=settings.floor_bytes)
        copied = put_back(conninfo, storage, folder.absolute())
    printer.print(
        copied,
        [f"{copied.rows} rows and {copied.contents} contents of {copied.size_bytes} bytes are restored."],
    )
    _report_damage(copied.damaged)


def _report_damage(sentences: Sequence[str]) -> None:
    """Name what could not be copied.

    Raises:
        OctasplatError: there is something.
    """
    for sentence in sentences:
        click.echo(sentence, err=True)
    if sentences:
        raise OctasplatError(
            f"{len(sentences)} contents could not be copied, everything else was; upload them again, or make "
            "them anew."
        )


@contextlib.contextmanager
def _database_connection(settings: "WorkerSettings", *, exclusive: bool = False) -> Iterator[str]:
    """Yield the connection string; start the private database for the block if it does not run."""
    from octasplat.workers.postgres.embedded import EmbeddedPostgres
    from octasplat.workers.serve.local_service import lock_data_folder

    if settings.database_url is not None:
        yield settings.conninfo()
        return
    with lock_data_folder(settings.data) if exclusive else contextlib.nullcontext():
        database = EmbeddedPostgres(settings.data.absolute())
        # A database that runs already is left running.
        ran = database.is_running()
        conninfo = database.start()
        try:
            yield conninfo
        finally:
            if not ran:
                database.stop()
