"""``octasplat serve``: the whole service on one machine."""

from pathlib import Path

import click


@click.command(short_help="Run the whole service on this machine.")
@click.option("--data", type=click.Path(path_type=Path), metavar="FOLDER", help="Where everything is kept.")
@click.option("--host", help="Address to listen at.  [default: 127.0.0.1, this machine only]")
@click.option("--port", type=click.IntRange(0, 65535), help="Port to listen at.  [default: 8642]")
@click.option(
    "--queues",
    default="cpu",
    show_default=True,
    metavar="NAMES",
    help="What this machine works on, e.g. cpu=2; an empty text leaves the work to other machines.",
)
@click.option(
    "--demo",
    is_flag=True,
    help="Submit a generated scene, save its result in octasplat-demo, and stop.",
)
def serve(data: Path | None, host: str | None, port: int | None, queues: str, demo: bool) -> None:
    """Run the API, the web page, a worker and, unless DATABASE_URL names another, a database of its own.

    Ctrl-C stops everything; jobs under way write a checkpoint and go on at the next start.
    """
    import asyncio

    from workers.cli.commands.worker import parse_queues
    from workers.logs import log_to_stderr
    from workers.serve.machine import Plan, serve
    from workers.settings import WorkerSettings, load_settings

    log_to_stderr()
    settings = load_settings(WorkerSettings, data=data)
    plan = Plan(settings, host, port, parse_queues(queues))

    def say(address: str) -> None:
        click.echo(f"octasplat serves at {address}  (Ctrl-C stops it)")

    async def show(address: str) -> None:
        from workers.cli.submitting import run_demo

        say(address)
        await asyncio.to_thread(run_demo, address)

    raise SystemExit(asyncio.run(serve(plan, show if demo else say)))
