"""``octasplat token``: who may use the service."""

import uuid
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

if TYPE_CHECKING:
    from workers.records.database import Connection

T = TypeVar("T")

SCOPES = ("read", "write", "admin")


@click.group(short_help="Who may use the service.")
def token() -> None:
    """Make, list and revoke access tokens, straight in the database."""


@token.command(short_help="Make a token.")
@click.argument("name")
@click.option("--owner", help="Whose things it shows.  [default: NAME]")
@click.option("--scope", "scopes", multiple=True, type=click.Choice(SCOPES), help="[default: write]")
@click.option("--data", type=click.Path(path_type=Path), metavar="FOLDER")
def create(name: str, owner: str | None, scopes: tuple[str, ...], data: Path | None) -> None:
    """Make a token called NAME and show its secret, this once. From the first on, nobody gets in without."""
    from workers.records.tokens import add_token, new_secret

    secret = new_secret()

    async def add(connection: "Connection") -> None:
        await add_token(connection, secret, owner=owner or name, name=name, scopes=scopes or ("write",))

    _with_database(data, add)
    click.echo(secret)


@token.command("list", short_help="List tokens.")
@click.option("--data", type=click.Path(path_type=Path), metavar="FOLDER")
def list_all(data: Path | None) -> None:
    """List all tokens, without their secrets."""
    from workers.records.tokens import list_tokens

    for row in _with_database(data, list_tokens):
        state = "revoked" if row.revoked_at else ",".join(row.scopes)
        click.echo(f"{row.id}  {row.name:20}  {row.owner:20}  {state}")


@token.command(short_help="Shut a token out.")
@click.argument("token_id", type=click.UUID)
@click.option("--data", type=click.Path(path_type=Path), metavar="FOLDER")
def revoke(token_id: uuid.UUID, data: Path | None) -> None:
    """Shut the token TOKEN_ID out."""
    from workers.records.tokens import revoke_token

    found = _with_database(data, lambda connection: revoke_token(connection, token_id))
    click.echo("Revoked." if found else "There is no such token.")


def _with_database(data: Path | None, what: Callable[["Connection"], Awaitable[T]]) -> T:
    """Run something on a connection, after bringing the tables up to date."""
    import asyncio

    from workers.records.database import open_pool
    from workers.records.migrate import migrate
    from workers.settings import WorkerSettings, load_settings

    conninfo = load_settings(WorkerSettings, data=data).conninfo()
    migrate(conninfo)

    async def run() -> T:
        async with open_pool(conninfo, max_size=1) as pool, pool.connection() as connection:
            return await what(connection)

    return asyncio.run(run())
