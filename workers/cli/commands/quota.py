"""``octasplat quota``: what an owner of tokens may take."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from octasplat.workers.cli.database import run_with_database
from octasplat.workers.cli.printing import Printer, output_options

if TYPE_CHECKING:
    from octasplat.workers.db.connections import Connection


class _SizeNumber(click.ParamType[int]):
    """A number, also with k, M, G or T.

    Args:
        most: that the column of the table holds.
    """

    name = "number"

    def __init__(self, most: int) -> None:
        self._most = most

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        units = {"k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12}
        text = str(value).strip().lower()
        number, unit = (text[:-1], units[text[-1]]) if text[-1:] in units else (text, 1)
        if not (number.isascii() and number.isdigit() and len(number) < 20):
            self.fail(f"{value} is not a number such as 500, 20G or 1T", param, ctx)
        if int(number) * unit > self._most:
            self.fail(f"{value} is more than {self._most}", param, ctx)
        return int(number) * unit


@click.command(short_help="Show or set what an owner may take.")
@click.argument("owner")
@click.option("--bytes", "max_bytes", type=_SizeNumber(2**63 - 1), help="Contents stored, e.g. 20G.")
@click.option("--datasets", "max_datasets", type=_SizeNumber(2**31 - 1), help="Datasets.")
@click.option("--jobs", "max_jobs", type=_SizeNumber(2**31 - 1), help="Jobs that are queued or running.")
@click.option(
    "--share",
    type=click.FloatRange(0.01, 100),
    help="Share of the workers, where that of others is 1.",
)
@click.option("--clear", is_flag=True, help="Set no limits and no share but those given.")
@click.option(
    "--data", type=click.Path(path_type=Path), metavar="FOLDER", help="Data folder of octasplat serve."
)
@output_options
def quota(
    owner: str, clear: bool, data: Path | None, share: float | None, printer: Printer, **limits: int | None
) -> None:
    """Show what OWNER has and may have, after setting the limits that are given.

    All tokens of an owner share its limits. An owner with the share 2 gets twice the work done of one with 1,
    while both have jobs waiting.
    """
    rows, its_share = run_with_database(
        data, lambda connection: _set_and_read(connection, owner, clear, share, limits)
    )
    shown = [
        f"{name}: {used} of {'any number' if limit is None else limit}"
        for name, (used, limit) in rows.items()
    ]
    facts = {name: {"used": used, "limit": limit} for name, (used, limit) in rows.items()}
    printer.print(
        {**facts, "share": its_share},
        [*shown, f"share of the workers: {its_share:g}"],
    )


async def _set_and_read(
    connection: "Connection", owner: str, clear: bool, share: float | None, limits: dict[str, int | None]
) -> tuple[dict[str, tuple[int, int | None]], float]:
    """Return what is used of what may be, and the share of the workers."""
    from octasplat.workers.db.quotas import NO_QUOTA, Quota, quota_of, set_quota, usage_of

    if clear or any(value is not None for value in (share, *limits.values())):
        present = NO_QUOTA if clear else await quota_of(connection, owner)
        await set_quota(connection, owner, Quota(**limits, share=share).with_defaults(present))
    quota, usage = await quota_of(connection, owner), await usage_of(connection, owner)
    rows = {
        "bytes": (usage.bytes, quota.max_bytes),
        "datasets": (usage.datasets, quota.max_datasets),
        "unfinished jobs": (usage.jobs, quota.max_jobs),
    }
    return rows, 1.0 if quota.share is None else quota.share
