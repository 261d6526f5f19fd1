"""Talking to a service with the progress shown: submit, wait, save the results."""

from pathlib import Path
from typing import Any

import click

from octasplat.engine.evaluate.summary import summarize_run
from octasplat.workers.cli.printing import Printer
from octasplat.workers.cli.progress import show_progress
from octasplat.workers.client import submission
from octasplat.workers.client.api import Api
from octasplat.workers.client.submission import Derivation, JobFailedError, Submission

DEMO_OUTPUT = Path("octasplat-demo")


def submit(api: Api, request: Submission | Derivation, printer: Printer) -> dict[str, Any]:
    """Send the files that are missing and queue the job; returns the job."""
    with show_progress(quiet=printer.hides_progress) as listener:
        if isinstance(request, Derivation):
            job = submission.derive(api, request, listener)
        else:
            job = submission.submit(api, request, listener)
    _print_notes(job, printer)
    return job


def wait_for(api: Api, job_id: str, printer: Printer) -> dict[str, Any]:
    """Show a job's progress until it is over; returns it."""
    with show_progress(quiet=printer.hides_progress) as listener:
        return submission.wait_for_job(api, job_id, listener, printer.note)


def download_results(
    api: Api, job_id: str, folder: Path, names: tuple[str, ...], printer: Printer
) -> tuple[Path, ...]:
    """Save the results of a job, or only those called ``names``; returns the files."""
    with show_progress(quiet=printer.hides_progress) as listener:
        paths = submission.download_job(api, job_id, folder, names, listener)
    printer.note(f"Saved {len(paths)} file{'s' if len(paths) > 1 else ''} in {folder}.")
    return paths


def download_archive(api: Api, job_id: str, path: Path, printer: Printer) -> None:
    """Save all results of a job as one ZIP file."""
    with show_progress(quiet=printer.hides_progress) as listener:
        submission.download_job_archive(api, job_id, path, listener)
    printer.note(f"Saved all results in {path}.")


def submit_and_wait(api: Api, request: Submission | Derivation, output: Path, printer: Printer) -> None:
    """Submit, wait, download, and print a summary, or the job as JSON."""
    job = submit(api, request, printer)
    printer.note(f"Queued as job {job['id']}.")
    try:
        job = wait_for(api, job["id"], printer)
    except JobFailedError:
        if api.get(f"/v1/jobs/{job['id']}/artifacts")["artifacts"]:
            download_results(api, job["id"], output, (), printer)  # what succeeded
        raise
    except KeyboardInterrupt:
        click.echo(f"The job goes on without you: octasplat status {job['id']}", err=True)
        raise
    paths = download_results(api, job["id"], output, (), printer)
    is_run = (output / "metrics.json").exists()
    summary = summarize_run(output, job["options"].get("exports", ())) if is_run else ()
    printer.print({"job": job, "files": paths}, summary)


def _print_notes(job: dict[str, Any], printer: Printer) -> None:
    """Print the notes of a queued job."""
    if not printer.hides_progress and job.get("estimate"):
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
    submit_and_wait(api, Submission(scene, options=options, label="demo"), output / "result", Printer())
    click.echo(f"Open {output / 'result' / 'report.html'} in a browser to see the result.")
