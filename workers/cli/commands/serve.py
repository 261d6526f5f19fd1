"""``octasplat serve``: the whole service on one machine."""

from pathlib import Path

import click


@click.command(short_help="Run the whole service on this machine.")
@click.option(
    "--data",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="Where everything is kept.  [default: OCTASPLAT_DATA, or octasplat in the user's folder of data; of "
    "root /var/lib/octasplat]",
)
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
@click.option(
    "--open/--no-open", "open_page", default=None, help="Open the page, signed in.  [default: on a desktop]"
)
def serve(
    data: Path | None, host: str | None, port: int | None, queues: str, demo: bool, open_page: bool | None
) -> None:
    """Run the API, the web page, a worker and, unless DATABASE_URL names another, a database of its own.

    It makes itself a token, kept in the data folder, that the commands of the same user find by themselves;
    octasplat open signs a browser in. Ctrl-C stops everything; jobs under way write a checkpoint and go on at
    the next start.
    """
    import asyncio
    import contextlib
    import threading

    from octasplat.engine.core.errors import OctasplatError
    from octasplat.workers.cli.browser import has_display, open_signed_in
    from octasplat.workers.cli.commands.worker import parse_queues
    from octasplat.workers.client.api import Api
    from octasplat.workers.logs import log_to_stderr
    from octasplat.workers.serve.local_service import ServeOptions, serve
    from octasplat.workers.settings import WorkerSettings, load_settings

    log_to_stderr()
    settings = load_settings(WorkerSettings, data=data)
    plan = ServeOptions(settings, host, port, parse_queues(queues))

    def show_page() -> None:
        with contextlib.suppress(OctasplatError), Api.local(settings.data) as api:
            open_signed_in(api)

    def say(address: str) -> None:
        click.echo(f"octasplat serves at {address}  (Ctrl-C stops it; octasplat open signs a browser in)")
        if (has_display() if open_page is None else open_page) and not demo:
            # In a thread, as it waits until the browser has read the link.
            threading.Thread(target=show_page, daemon=True).start()

    async def show(address: str) -> None:
        from octasplat.workers.cli.remote_jobs import run_demo

        say(address)
        with Api.local(settings.data) as api:
            await asyncio.to_thread(run_demo, api)

    raise SystemExit(asyncio.run(serve(plan, show if demo else say)))
