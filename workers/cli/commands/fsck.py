"""``octasplat fsck``: comparison of the storage with what the tables reference."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from octasplat.workers.cli.printing import Printer, output_options

if TYPE_CHECKING:
    from octasplat.workers.settings import WorkerSettings
    from octasplat.workers.storage.fsck import Reference, Report

_MAX_SHOWN_FINDINGS = 50


@click.command(short_help="Compare the tables of a service with its store.")
@click.option(
    "--data", type=click.Path(path_type=Path), metavar="FOLDER", help="Data folder of octasplat serve."
)
@click.option("--verify", is_flag=True, help="Read every content and compare its digest; takes long.")
@click.option("--recount", is_flag=True, help="Count anew what each owner stores; uploads wait meanwhile.")
@output_options
def fsck(data: Path | None, verify: bool, recount: bool, printer: Printer) -> None:
    """Report contents that the tables name but the store lacks or has damaged, and contents nothing names.

    Changes nothing but, with --recount, the numbers of bytes that quotas are checked against. The exit code
    is 1 if something that is needed is missing or damaged.
    """
    from octasplat.workers.settings import WorkerSettings, load_settings

    settings = load_settings(WorkerSettings, data=data)
    if recount:
        for line in _recount_quotas(settings):
            printer.note(line)
    report = _print_report(settings, verify)
    printer.print(report, report_lines(report))
    raise SystemExit(0 if report.is_sound else 1)


def report_lines(report: "Report") -> list[str]:
    """Return the report for people."""
    lines = [
        f"{finding.kind}: {finding.where}: {finding.detail} ({finding.sha256})"
        for finding in report.findings[:_MAX_SHOWN_FINDINGS]
    ]
    if len(report.findings) > _MAX_SHOWN_FINDINGS:
        lines.append(f"... and {len(report.findings) - _MAX_SHOWN_FINDINGS} more; --json lists all.")
    lines.append(
        f"{report.references} places in the tables, {report.blobs} contents of {report.blob_bytes} bytes in "
        "the store" + (f", {report.verified} of them read whole." if report.verified else ".")
    )
    if report.unused:
        lines.append(f"{len(report.unused)} contents of {report.unused_bytes} bytes are named by nothing.")
    if report.young:
        lines.append(f"{report.young} contents came within the last hour and are named by nothing yet.")
    lines.append(
        "Everything that is named is there."
        if report.is_sound
        else f"{len(report.findings)} places name content that is missing or damaged; restore the store "
        "from a backup of the same time, or delete these datasets and jobs."
    )
    return lines


def _print_report(settings: "WorkerSettings", verify: bool) -> "Report":
    import asyncio

    from octasplat.workers.storage.factory import open_storage
    from octasplat.workers.storage.fsck import compare_with_storage

    conninfo = settings.conninfo()
    storage = open_storage(settings.storage_address, floor_bytes=0)
    return compare_with_storage(storage, asyncio.run(_read_references(conninfo)), verify=verify)


def _recount_quotas(settings: "WorkerSettings") -> list[str]:
    import asyncio

    from octasplat.workers.db.connections import open_pool
    from octasplat.workers.db.quotas import recount

    async def count() -> list[str]:
        async with open_pool(settings.conninfo(), max_size=1) as pool, pool.connection() as connection:
            return [
                f"{found.owner}: {found.bytes_before} bytes were counted; {found.bytes} it is."
                for found in await recount(connection)
            ]

    return asyncio.run(count())


async def _read_references(conninfo: str) -> "list[Reference]":
    from octasplat.workers.db.connections import open_pool
    from octasplat.workers.db.references import references

    async with open_pool(conninfo, max_size=1) as pool, pool.connection() as connection:
        return [reference async for reference in references(connection)]
