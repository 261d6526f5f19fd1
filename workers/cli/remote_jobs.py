"""Talking to a service with the progress shown: submit, wait, save the results."""

from pathlib import Path
from typing import Any

import click

from octasplat.engine.evaluate.summary import summarize_run
from octasplat.workers.cli.progress import show_progress
from octasplat.workers.client import submission
from octasplat.workers.client.api import Api
from octasplat.workers.client.submission import Derivation, JobFailedError, Submission

DEMO_OUTPUT = Path("octasplat-demo")


def submit(api: Api, request: Submission, *, quiet: bool = False) -> dict[str, Any]:
    """Upload what is missing and queue the job; returns the job."""
    with show_progress(quiet=quiet) as listener:
        job = submission.submit(api, request, listener)
    _print_notes(job, quiet=quiet)
    return job


def derive(api: Api, request: Derivation, *, quiet: bool = False) -> dict[str, Any]:
    """Send the files that are named and queue a job on the results of another; returns the job."""
    with show_progress(quiet=quiet) as listener:
        job = submission.derive(api, request, listener)
    _print_notes(job, quiet=quiet)
    return job


def wait_for(api: Api, job_id: str, *, quiet: bool = False) -> dict[str, Any]:
    """Show a job's progress until it is over; returns it."""
    with show_progress(quiet=quiet) as listener:
        return submission.wait_for_job(api, job_id, listener, (lambda _note: None) if quiet else click.echo)


def download_results(
    api: Api, job_id: str, folder: Path, names: tuple[str, ...] = (), *, quiet: bool = False
) -> None:
    """Save the results of a job."""
    with show_progress(quiet=quiet) as listener:
        paths = submission.download_job(api, job_id, folder, names, listener)
    if not quiet:
        click.echo(f"Saved {len(paths)} file{'s' if len(paths) > 1 else ''} in {folder}.")


def submit_and_wait(api: Api, request: Submission | Derivation, output: Path, *, quiet: bool = False) -> None:
    """Submit, wait, download, and print a summary."""
    job = (
        derive(api, request, quiet=quiet)
        if isinstance(request, Derivation)
        else submit(api, request, quiet=quiet)
    )
    if not quiet:
        click.echo(f"Queued as job {job['id']}.")
    try:
        job = wait_for(api, job["id"], quiet=quiet)
    except JobFailedError:
        if api.get(f"/v1/jobs/{job['id']}/artifacts")["artifacts"]:
            download_results(api, job["id"], output, quiet=quiet)  # what succeeded
        raise
    except KeyboardInterrupt:
        click.echo(f"The job goes on without you: octasplat status {job['id']}", err=True)
        raise
    download_results(api, job["id"], output, quiet=quiet)
    if not quiet and (output / "metrics.json").exists():
        for line in summarize_run(output, job["options"].get("exports", ())):
            click.echo(line)


def _print_notes(job: dict[str, Any], *, quiet: bool) -> None:
    """Print the notes of a queued job."""
    if not quiet and job.get("estimate"):
        click.echo(f"Estimate: {job['estimate']['text']}, within a factor of two.", err=True)
    for note in job.get("notes", ()):
        click.echo(f"Note: {note}", err=True)


def run_demo(api: Api, output: Path = DEMO_OUTPUT) -> None:
    """Reconstruct the demo scene through the service.

    Args:
        api: the service.
        output: folder for the scene and the result.
    """
    from octasplat.workers.cli.demo_run import make_demo_scene

    scene = output / "scene"
    make_demo_scene(scene, {}, quiet=False)
    options = {"preset": "fast", "train": {"iterations": 2000}}
    submit_and_wait(api, Submission(scene, options=options, label="demo"), output / "result")
    click.echo(f"Open {output / 'result' / 'report.html'} in a browser to see the result.")
