"""``octasplat token``: who may use the service."""

import getpass
import os
import uuid
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from octasplat.engine.core.errors import ConfigError
from octasplat.workers.cli.database import run_with_database
from octasplat.workers.cli.printing import Printer, output_options, table_lines

if TYPE_CHECKING:
    from octasplat.workers.db.connections import Connection
    from octasplat.workers.db.rows import Token

SCOPES = ("read", "write", "admin", "metrics")

_data_option = click.option(
    "--data", type=click.Path(path_type=Path), metavar="FOLDER", help="Data folder of octasplat serve."
)


@click.group(short_help="Who may use the service.")
def token() -> None:
    """Make, list and revoke access tokens, straight in the database."""


@token.command(short_help="Make a token.")
@click.argument("name")
@click.option("--owner", help="Whose things it shows.  [default: NAME]")
@click.option(
    "--scope",
    "scopes",
    multiple=True,
    type=click.Choice(SCOPES),
    help="What it may do; may be repeated.  [default: write]",
)
@click.option(
    "--days",
    type=click.FloatRange(min=0, min_open=True),
    help="How long it is valid.  [default: until it is revoked]",
)
@_data_option
@output_options
def create(
    name: str,
    owner: str | None,
    scopes: tuple[str, ...],
    days: float | None,
    data: Path | None,
    printer: Printer,
) -> None:
    """Make a token called NAME and show its secret, this once."""
    from octasplat.workers.db.tokens import add_token, new_secret

    secret = new_secret()

    async def add(connection: "Connection") -> "Token":
        made = await add_token(
            connection,
            secret,
            owner=owner or name,
            name=name,
            scopes=scopes or ("write",),
            hours=None if days is None else 24 * days,
        )
        await _add_audit_entry(connection, "token create", f"/v1/tokens/{made.id}")
        return made

    made = run_with_database(data, add)
    printer.print({"id": made.id, "secret": secret}, [secret], quiet_lines=[secret])


@token.command("list", short_help="List tokens.")
@_data_option
@output_options
def list_all(data: Path | None, printer: Printer) -> None:
    """List all tokens, without their secrets."""
    from octasplat.workers.db.tokens import list_tokens

    now = datetime.now(UTC)
    found = run_with_database(data, list_tokens)
    rows = []
    for row in found:
        state = "revoked" if row.revoked_at else ",".join(row.scopes)
        end = ""
        if row.expires_at is not None and not row.revoked_at:
            end = f"{'expired' if row.expires_at < now else 'until'} {row.expires_at:%Y-%m-%d}"
        rows.append((row.id, row.name, row.owner, state, end))
    printer.print(
        [{name: value for name, value in asdict(row).items() if name != "sha256"} for row in found],
        table_lines(("Id", "Name", "Owner", "Scopes", "Valid"), rows) or ["No tokens."],
        quiet_lines=[str(row.id) for row in found],
    )


@token.command(short_help="Shut a token out.")
@click.argument("token_id", type=click.UUID)
@_data_option
@output_options
def revoke(token_id: uuid.UUID, data: Path | None, printer: Printer) -> None:
    """Revoke the token TOKEN_ID, with the browser sessions that were begun with it."""
    from octasplat.workers.db.tokens import revoke_token

    async def shut(connection: "Connection") -> bool:
        # In the same transaction, so that no change stays out of the audit.
        await _add_audit_entry(connection, "token revoke", f"/v1/tokens/{token_id}")
        return await revoke_token(connection, token_id)

    if not run_with_database(data, shut):
        raise ConfigError(f"There is no valid token {token_id}; octasplat token list shows them.")
    printer.print({"revoked": True}, ["Revoked."])


async def _add_audit_entry(connection: "Connection", action: str, target: str) -> None:
    from octasplat.workers.db.audit import add_entry

    await add_entry(
        connection, address="command line", owner=_local_user_name(), action=action, target=target
    )


def _local_user_name() -> str:
    """Return the name of whoever gives the command, on this machine."""
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # no name
        return str(os.getuid())
