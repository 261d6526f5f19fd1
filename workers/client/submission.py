"""From a folder to results: upload, queue, wait, download."""

import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click

from engine.errors import OctasplatError
from workers.client.api import Api
from workers.client.download import download_results
from workers.client.upload import upload_scene
from workers.client.watch import watch_job
from workers.progress import show_progress, staged


class JobFailed(OctasplatError):
    """The job ended without a result."""


@dataclass(frozen=True)
class Submission:
    """What to ask for.

    Attributes:
        scene: folder of photographs, ZIP file, or the id of a dataset.
        options: of the reconstruction.
        label: what to call the job.
        queue: which workers.
        priority: higher goes first.
    """

    scene: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    label: str | None = None
    queue: str = "cpu"
    priority: int = 0


def submit(api: Api, what: Submission, *, quiet: bool = False) -> dict[str, Any]:
    """Upload what is missing and queue the job; returns the job.

    Raises:
        OctasplatError: the scene or the options are refused, or the service does not answer.
    """
    dataset_id = _as_id(str(what.scene))
    if dataset_id is None:
        with show_progress(quiet=quiet) as listener, staged("upload", listener) as progress:
            dataset = upload_scene(api, what.scene, progress=lambda d, t: progress(d >> 10, t >> 10))
        dataset_id = dataset["id"]
        for warning in dataset["facts"].get("warnings", ()):
            click.echo(f"Warning: {warning}", err=True)
    body = {
        "dataset_id": dataset_id,
        "options": dict(what.options),
        "label": what.label,
        "queue": what.queue,
        "priority": what.priority,
    }
    job: dict[str, Any] = api.post("/v1/jobs", body)
    if not quiet and job.get("estimate"):
        click.echo(f"Estimate: {job['estimate']['text']}, within a factor of two.", err=True)
    for note in job.get("notes", ()):
        click.echo(f"Note: {note}", err=True)
    return job


def wait_for(api: Api, job_id: str, *, quiet: bool = False) -> dict[str, Any]:
    """Show a job's progress until it is over; returns it.

    Raises:
        JobFailed: it failed or was cancelled.
    """

    def on_state(event: dict[str, Any]) -> None:
        text = {
            "rescued": "The worker was lost; another one goes on.",
            "handed_back": "The worker stops; another one goes on.",
            "resumed": f"Going on from step {event.get('step')} of {event.get('stage')}.",
        }.get(event["kind"])
        if text is not None and not quiet:
            click.echo(text)

    with show_progress(quiet=quiet) as listener:
        job = watch_job(api, job_id, listener, on_state)
    if job["state"] == "failed":
        raise JobFailed(f"The job failed: {job['error']['message']} (octasplat logs {job_id} says more)")
    if job["state"] == "canceled":
        raise JobFailed("The job was cancelled; octasplat retry goes on with it.")
    return job


def fetch(api: Api, job_id: str, folder: Path, names: tuple[str, ...] = (), *, quiet: bool = False) -> None:
    """Save the results of a job."""
    with show_progress(quiet=quiet) as listener, staged("download", listener) as progress:
        paths = download_results(
            api, job_id, folder, names=names, progress=lambda d, t: progress(d >> 10, t >> 10)
        )
    if not quiet:
        click.echo(f"Saved {len(paths)} file{'s' if len(paths) > 1 else ''} in {folder}.")


def submit_and_wait(api: Api, what: Submission, output: Path, *, quiet: bool = False) -> None:
    """All of it, and a summary at the end."""
    from workers.wording import run_summary

    job = submit(api, what, quiet=quiet)
    if not quiet:
        click.echo(f"Queued as job {job['id']}.")
    try:
        job = wait_for(api, job["id"], quiet=quiet)
    except JobFailed:
        if api.get(f"/v1/jobs/{job['id']}/artifacts")["artifacts"]:
            fetch(api, job["id"], output, quiet=quiet)  # what succeeded
        raise
    except KeyboardInterrupt:
        click.echo(f"The job goes on without you: octasplat status {job['id']}", err=True)
        raise
    fetch(api, job["id"], output, quiet=quiet)
    if not quiet and (output / "metrics.json").exists():
        for line in run_summary(output, job["options"].get("exports", ())):
            click.echo(line)


def _as_id(text: str) -> str | None:
    try:
        return str(uuid.UUID(text))
    except ValueError:
        return None
