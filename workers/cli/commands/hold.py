"""``octasplat pause``, ``unpause``, ``drain`` and ``undrain``: what an administrator holds back."""

from typing import Any
from urllib.parse import quote

import click

from octasplat.workers.cli.printing import Printer, output_options
from octasplat.workers.cli.service_options import connected, server_option


@click.command(short_help="Let a queue hand out no jobs.")
@click.argument("queue")
@server_option
@output_options
def pause(queue: str, server: str | None, printer: Printer) -> None:
    """Let QUEUE hand out no jobs until `octasplat unpause`; those that run go on.

    Jobs are still accepted and keep their places. This needs an administrator's token.
    """
    found = _change(server, f"queues/{quote(queue, safe='')}", {"paused": True})
    printer.print(found, [f"The queue {queue} is paused; {found['waiting']} jobs wait."])


@click.command(short_help="Let a paused queue hand out jobs again.")
@click.argument("queue")
@server_option
@output_options
def unpause(queue: str, server: str | None, printer: Printer) -> None:
    """Let the paused QUEUE hand out jobs again."""
    found = _change(server, f"queues/{quote(queue, safe='')}", {"paused": False})
    printer.print(found, [f"The queue {queue} hands out jobs."])


@click.command(short_help="Let a worker finish what it has and take nothing new.")
@click.argument("worker")
@server_option
@output_options
def drain(worker: str, server: str | None, printer: Printer) -> None:
    """Let WORKER finish what it has and take nothing new until `octasplat undrain`.

    `octasplat workers` lists the names. One that was named by `octasplat worker --name` is still drained when
    it starts again. This needs an administrator's token.
    """
    found = _change(server, f"workers/{quote(worker, safe='')}", {"drained": True})
    left = f"it has {found['running']} jobs to finish" if found["running"] else "it has no jobs"
    printer.print(found, [f"The worker {worker} is drained; {left}."])


@click.command(short_help="Let a drained worker take jobs again.")
@click.argument("worker")
@server_option
@output_options
def undrain(worker: str, server: str | None, printer: Printer) -> None:
    """Let the drained WORKER take jobs again."""
    found = _change(server, f"workers/{quote(worker, safe='')}", {"drained": False})
    printer.print(found, [f"The worker {worker} takes jobs."])


def _change(server: str | None, what: str, change: dict[str, bool]) -> dict[str, Any]:
    with connected(server) as api:
        found: dict[str, Any] = api.patch(f"/v1/{what}", change)
    return found
