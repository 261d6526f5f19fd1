"""Commands on what a service has: its jobs, their logs and results, datasets and workers."""

import json
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import click

from octasplat.engine.core.durations import format_duration
from octasplat.workers.cli.printing import Printer, local_time, output_options, table_lines
from octasplat.workers.cli.service_options import connected, limit_option, server_option

_NO_WORKERS = "No live workers, or none that this token may see; administrators see all."
STATES = ("queued", "running", "canceling", "succeeded", "failed", "canceled")


@click.command(short_help="List jobs.")
@click.option("--state", multiple=True, type=click.Choice(STATES), help="Only these; may be repeated.")
@click.option("--kind", metavar="KIND", help="Only those of this kind, such as render.")
@click.option("--label", metavar="TEXT", help="Only those with exactly this label.")
@click.option(
    "--sort",
    type=click.Choice(("newest", "oldest", "name", "psnr", "longest")),
    default="newest",
    show_default=True,
    help="Which come first; psnr is the best one, longest the most work.",
)
@limit_option
@server_option
@output_options
def jobs(
    state: tuple[str, ...],
    kind: str | None,
    label: str | None,
    sort: str,
    limit: int,
    server: str | None,
    printer: Printer,
) -> None:
    """List jobs, the newest first unless sorted otherwise.

    Every command takes the id that is shown, a whole one of the JSON output, or 'last'.
    """
    from octasplat.workers.client.short_ids import list_rows, short_id

    query: dict[str, Any] = {"state": list(state)} if state else {}
    query |= {name: value for name, value in (("kind", kind), ("label", label)) if value is not None}
    if sort != "newest":
        query["order"] = sort
    with connected(server) as api:
        found = list(list_rows(api, "jobs", limit=limit, **query))
    rows = [
        (
            short_id(job["id"]),
            job["state"],
            job["kind"],
            local_time(job["created_at"]),
            _progress_text(job),
            _psnr_text(job),
            job["label"] or "",
        )
        for job in found
    ]
    headers = ("Id", "State", "Kind", "Created", "Progress", "PSNR", "Label")
    printer.print(found, table_lines(headers, rows) or ["No jobs."], quiet_lines=[job["id"] for job in found])


@click.command(short_help="List datasets, which hold the photographs of jobs.")
@limit_option
@server_option
@output_options
def datasets(limit: int, server: str | None, printer: Printer) -> None:
    """List datasets, the newest first; submit takes the id of one in the place of a folder."""
    from octasplat.workers.client.short_ids import list_rows, short_id

    with connected(server) as api:
        found = list(list_rows(api, "datasets", limit=limit))
    rows = [
        (
            short_id(dataset["id"]),
            dataset["state"],
            dataset["holds"],
            dataset["photographs"] or "",
            "yes" if dataset["has_poses"] else "",
            local_time(dataset["created_at"]),
            dataset["name"],
        )
        for dataset in found
    ]
    headers = ("Id", "State", "Holds", "Photographs", "Poses", "Created", "Name")
    printer.print(
        found, table_lines(headers, rows) or ["No datasets."], quiet_lines=[row["id"] for row in found]
    )


@click.command(short_help="List queues and the workers that take jobs from them.")
@server_option
@output_options
def workers(server: str | None, printer: Printer) -> None:
    """List the queues of the service with what waits in them, and its live workers."""
    with connected(server) as api:
        found = api.get("/v1/queues")
    queues = [
        (row["queue"], row["waiting"], row["running"], row["slots"], "paused" if row.get("paused") else "")
        for row in found["queues"]
    ]
    live = [
        (
            row["name"],
            ",".join(row["queues"]),
            row["slots"],
            local_time(row["started_at"]),
            "drained" if row.get("drained") else "",
        )
        for row in found["workers"]
    ]
    lines = [
        *table_lines(("Queue", "Waiting", "Running", "Slots", "State"), queues),
        *(
            ["", *table_lines(("Worker", "Queues", "Slots", "Since", "State"), live)]
            if live
            else [_NO_WORKERS]
        ),
    ]
    printer.print(found, lines, quiet_lines=[row["name"] for row in found["workers"]])


@click.command(short_help="Show a job, or wait for it.")
@click.argument("job_id", metavar="JOB")
@click.option("--wait", is_flag=True, help="Show the progress until it is over.")
@server_option
@output_options
def status(job_id: str, wait: bool, server: str | None, printer: Printer) -> None:
    """Show how far JOB is; 'last' is the newest one."""
    from octasplat.workers.cli.remote_jobs import wait_for
    from octasplat.workers.client.short_ids import find_job

    with connected(server, awaits_start=wait) as api:
        job = find_job(api, job_id)
        if wait:
            job = wait_for(api, job["id"], printer)
    printer.print(job, _job_lines(job), quiet_lines=[job["state"]])


def _job_lines(job: dict[str, Any]) -> Iterator[str]:
    """Yield sentences about a job."""
    yield f"{job['kind']} {job['id']}: {job['state']} {_progress_text(job)}".rstrip()
    if job["state"] == "running" and job.get("total_seconds_left") is not None:
        left = format_duration(job["total_seconds_left"])
        yield f"{job['progress']:.0%} of the whole, about {left} left."
    if job.get("estimate") and job["state"] in ("queued", "running"):
        yield f"Estimated when it was asked for: {job['estimate']['text']}, within a factor of two."
    yield from job.get("notes", ())
    if job["psnr"] is not None:
        training = job.get("training_psnr")
        rest = f"; {training:.2f} dB over the training's own rays" if training is not None else ""
        yield f"PSNR {_psnr_text(job)} over held-out views{rest}"
    if job["error"]:
        yield job["error"]["message"]


@click.command(short_help="Show the log of a job.")
@click.argument("job_id", metavar="JOB")
@click.option("-f", "--follow", is_flag=True, help="Go on until the job is over.")
@click.option("--json", "as_json", is_flag=True, help="Print each line as a JSON object.")
@server_option
def logs(job_id: str, follow: bool, as_json: bool, server: str | None) -> None:
    """Show what JOB did when, and what its program wrote; times are this machine's."""
    from octasplat.workers.client.short_ids import find_job

    with connected(server) as api:
        job = find_job(api, job_id)
        after = 0
        while True:
            # Before the lines are read, so that the last ones are among them.
            over = job["state"] in ("succeeded", "failed", "canceled")
            page = api.get(f"/v1/jobs/{job['id']}/logs", after=after)
            for line in page["lines"]:
                click.echo(json.dumps(line) if as_json else f"{_local_clock(line['at'])}  {line['text']}")
            after = page["next"]
            if page["lines"]:
                continue
            if over or not follow:
                return
            time.sleep(1)
            job = find_job(api, job["id"])


@click.command(short_help="Stop a job.")
@click.argument("job_id", metavar="JOB")
@server_option
@output_options
def cancel(job_id: str, server: str | None, printer: Printer) -> None:
    """Stop JOB; it keeps its checkpoint."""
    from octasplat.workers.client.short_ids import find_job

    with connected(server) as api:
        job = api.post(f"/v1/jobs/{find_job(api, job_id)['id']}/cancel")
    printer.print(job, [f"{job['id']}: {job['state']}"])


@click.command(short_help="Save the results of a job.")
@click.argument("job_id", metavar="JOB")
@click.argument("names", nargs=-1)
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder.  [default: octasplat-<job>]")
@click.option(
    "--archive",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.zip",
    help="All results as this one ZIP file instead.",
)
@server_option
@output_options
def download(
    job_id: str,
    names: tuple[str, ...],
    output: Path | None,
    archive: Path | None,
    server: str | None,
    printer: Printer,
) -> None:
    """Save the results of JOB, or only those called NAMES; goes on where it broke off."""
    from octasplat.workers.cli.remote_jobs import download_archive, download_results
    from octasplat.workers.client.short_ids import find_job, short_id

    if archive is not None and (names or output is not None):
        raise click.UsageError("--archive takes all results, so it goes with neither NAMES nor -o.")
    with connected(server, awaits_start=True) as api:
        job = find_job(api, job_id)
        if archive is not None:
            download_archive(api, job["id"], archive, printer)
            printer.print({"archive": archive}, ())
            return
        folder = output or Path(f"octasplat-{short_id(job['id'])}")
        paths = download_results(api, job["id"], folder, names, printer)
    printer.print({"folder": folder, "files": paths}, ())


def _psnr_text(job: dict[str, Any]) -> str:
    """Return the PSNR over held-out views."""
    return "" if job["psnr"] is None else f"{job['psnr']:.2f} dB"


def _local_clock(at: str) -> str:
    """Return a time of the service as this machine's clock shows it, to the second."""
    return datetime.fromisoformat(at).astimezone().strftime("%H:%M:%S")


def _progress_text(job: dict[str, Any]) -> str:
    """Return how far a job is, in a few words."""
    if job["state"] == "queued":
        ahead = job["queue_position"]
        return f"{ahead} before it" if ahead else ""
    if job["state"] != "running" or not job["stage"]:
        return ""
    count = f" {job['step']}/{job['total_steps']}" if job["total_steps"] else ""
    return f"{job['stage']}{count}"
