"""``octasplat worker``: takes jobs from the queue."""

import re
from pathlib import Path

import click

_QUEUE = re.compile(r"([a-z][a-z0-9_-]{0,40})(?:=(\d{1,3}))?")


def parse_queues(text: str) -> dict[str, int]:
    """Return the queue names and job counts in a text such as ``cpu,long=2``.

    Raises:
        click.UsageError: it cannot be read so.
    """
    queues: dict[str, int] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        match = _QUEUE.fullmatch(part)
        count = int(match[2] or 1) if match is not None else 0
        if match is None or count == 0:
            raise click.UsageError(
                f"--queues {part}: write a name such as cpu, or cpu=2 for two jobs at once."
            )
        if match[1] in queues:
            raise click.UsageError(f"--queues {text}: {match[1]} is named twice; name it once.")
        queues[match[1]] = count
    return queues


@click.command(short_help="Take jobs from the queue of a service.")
@click.option(
    "--queues",
    default="cpu",
    show_default=True,
    metavar="NAMES",
    help="Queues to take jobs from, e.g. cpu or cpu=2,long; an empty text only looks after lost jobs.",
)
@click.option("--name", metavar="NAME", help="Name of this worker.  [default: host and process id]")
@click.option(
    "--data", type=click.Path(path_type=Path), metavar="FOLDER", help="Data folder of octasplat serve."
)
def worker(queues: str, name: str | None, data: Path | None) -> None:
    """Take jobs from the queue and do them, one at a time or more.

    On further hosts set DATABASE_URL, and OCTASPLAT_STORAGE to a store that all hosts reach. SIGTERM writes a
    checkpoint and hands the job to another worker.
    """
    import asyncio

    from octasplat.workers.logs import log_to_stderr
    from octasplat.workers.settings import WorkerSettings, load_settings
    from octasplat.workers.worker.worker_process import run_worker

    chosen = parse_queues(queues)
    log_to_stderr()
    settings = load_settings(WorkerSettings, data=data)
    raise SystemExit(asyncio.run(run_worker(settings, chosen, name=name)))
