"""Commands that talk to a service: submit, derive, and those on its jobs, datasets and workers."""

import copy
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from octasplat.engine.core.durations import format_duration
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.operations.reconstruct import ReconstructOptions
from octasplat.engine.settings.renamed_settings import notify_renamed
from octasplat.workers.cli.options import exports_option, parse_export_names
from octasplat.workers.cli.printing import Printer, local_time, output_options, table_lines
from octasplat.workers.cli.request_options import request_from_options, request_options

if TYPE_CHECKING:
    from octasplat.workers.client.api import Api

F = TypeVar("F", bound=Callable[..., Any])
_NO_WORKERS = "No live workers, or none that this token may see; administrators see all."
STATES = ("queued", "running", "canceling", "succeeded", "failed", "canceled")


def server_option(command: F) -> F:
    """Add the option ``--server`` to a command."""
    return click.option(
        "--server",
        metavar="URL",
        help="The service.  [default: OCTASPLAT_SERVER, or octasplat serve of this machine]",
    )(command)


def set_option(command: F) -> F:
    """Add the option ``--set`` to a command."""
    return click.option(
        "--set",
        "assignments",
        multiple=True,
        metavar="NAME=VALUE",
        help="Any setting, e.g. test_every=10 or lr.quat=0.02; may be repeated.",
    )(command)


def limit_option(command: F) -> F:
    """Add the option ``--limit`` of lists to a command."""
    return click.option(
        "--limit", type=click.IntRange(1, 1000), default=20, show_default=True, metavar="N",
        help="Most rows to list.",
    )(command)  # fmt: skip


@contextmanager
def connected(server: str | None, *, awaits_start: bool = False) -> Iterator["Api"]:
    """Yield the service that the user means; the token is no option, as others on a machine see those.

    Args:
        server: its address; None for that of the environment or of this machine.
        awaits_start: whether the command waits for a service that is being started again, as long work does;
            else a refused connection is told at once.
    """
    from octasplat.workers.client.api import Api, find_address, find_token

    address = server or find_address(os.environ)
    with Api(address, find_token(os.environ, address), awaits_start=awaits_start) as api:
        yield api


@click.command(short_help="Send a scene to the service and queue its reconstruction.")
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("--wait", is_flag=True, help="Show the progress and save the results at the end.")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="With --wait: folder for the results.")
@request_options(ReconstructOptions)
@click.option("--label", help="What to call the job.")
@click.option("--queue", default="cpu", show_default=True, help="Which workers.")
@click.option(
    "--priority", type=click.IntRange(-100, 100), default=0, help="Among your jobs, higher goes first."
)
@server_option
@output_options
def submit(
    scene: Path,
    wait: bool,
    output: Path | None,
    label: str | None,
    queue: str,
    priority: int,
    server: str | None,
    printer: Printer,
    **given: Any,
) -> None:
    """Send SCENE: a folder with images/ (and sparse/0), one of photographs, a ZIP file or a dataset's id.

    The same command goes on with an upload that broke off.
    """
    from octasplat.workers.cli.remote_jobs import submit, submit_and_wait
    from octasplat.workers.client.submission import Submission

    _check_output(output, wait=wait)
    options: ReconstructOptions = request_from_options(ReconstructOptions, given)
    options.config()  # what cannot be used is refused before anything is sent
    requested = options.model_dump(mode="json", exclude_unset=True)
    what = Submission(scene, requested, label, queue, priority)
    with connected(server, awaits_start=True) as api:
        what = replace(what, scene=_as_dataset(api, scene))
        if wait:
            submit_and_wait(api, what, output or Path(f"{scene.stem or 'scene'}-result"), printer)
            return
        job = submit(api, what, printer)
    printer.print(job, [job["id"]], quiet_lines=[job["id"]])


@click.command(short_help="Queue a job on the results of a finished one, such as a render.")
@click.argument("kind")
@click.argument("job_id", metavar="[JOB]", required=False)
@click.option(
    "--file",
    "files",
    multiple=True,
    metavar="OPTION=PATH",
    help="A file for an option that names one, such as meshes=edited.ply, which is sent; may be repeated.",
)
@click.option(
    "--stage",
    type=click.Path(path_type=Path),
    metavar="STAGE.toml",
    help="Render: the stage; it and the files that it names are sent.",
)
@click.option(
    "--path",
    "path_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Render, relight: the cameras of a JSON file, which docs/cameras.md describes.",
)
@click.option(
    "--environment",
    "environments",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="MAP",
    help="Relight: an HDR or EXR image, which is sent; several have their turns.",
)
@click.option(
    "--other-dataset",
    type=click.Path(path_type=Path),
    metavar="DATASET",
    help="Evaluate: measure all photographs of this folder, ZIP file or dataset in the same world instead.",
)
@click.option("--on", "former_on", type=click.Path(path_type=Path), hidden=True)
@set_option
@click.option("--wait", is_flag=True, help="Show the progress and save the results at the end.")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="With --wait: folder for the results.")
@click.option("--label", help="What to call the job.")
@click.option("--queue", default="cpu", show_default=True, help="Which workers.")
@click.option(
    "--priority", type=click.IntRange(-100, 100), default=0, help="Among your jobs, higher goes first."
)
@server_option
@output_options
def derive(
    kind: str,
    job_id: str | None,
    stage: Path | None,
    path_file: Path | None,
    environments: tuple[Path, ...],
    other_dataset: Path | None,
    former_on: Path | None,
    wait: bool,
    output: Path | None,
    server: str | None,
    printer: Printer,
    **given: Any,
) -> None:
    """Queue a job of a KIND such as render, crop or edit on the results of JOB, or one on files alone.

    'last' is the newest job; octasplat verbs lists the kinds. For example:
    octasplat derive render last --stage stage.toml --set frames=60, or:
    octasplat derive material last --set set.roughness=0.3 --set where="metallic > 0.5" --wait, or:
    octasplat derive edit last --file meshes=edited.ply, or: octasplat derive import --file file=a.splat
    """
    from octasplat.workers.cli.named_files import with_named_files
    from octasplat.workers.cli.remote_jobs import derive, submit_and_wait
    from octasplat.workers.client.short_ids import find_job
    from octasplat.workers.client.submission import (
        Derivation,
        with_camera_path,
        with_environments,
        with_stage,
    )

    _check_output(output, wait=wait)
    if former_on is not None:
        notify_renamed({"--on": "--other-dataset"})
    files = [_parse_file_option(text) for text in given["files"]]
    with connected(server, awaits_start=wait) as api:
        source = None if job_id is None else find_job(api, job_id)["id"]
        photographs = other_dataset or former_on
        what = Derivation(
            source,
            kind,
            _with_assignments({}, given["assignments"]),
            scene=None if photographs is None else _as_dataset(api, photographs),
            label=given["label"],
            queue=given["queue"],
            priority=given["priority"],
        )
        what = with_named_files(what, files)
        if stage is not None:
            what = with_stage(what, stage)
        if path_file is not None:
            what = with_camera_path(what, path_file)
        if environments:
            what = with_environments(what, environments)
        if wait:
            submit_and_wait(api, what, output or Path(f"{kind}-result"), printer)
            return
        job = derive(api, what, printer)
    printer.print(job, [job["id"]], quiet_lines=[job["id"]])


@click.command(short_help="List jobs.")
@click.option("--state", multiple=True, type=click.Choice(STATES), help="Only these; may be repeated.")
@click.option("--label", metavar="TEXT", help="Only those with exactly this label.")
@limit_option
@server_option
@output_options
def jobs(state: tuple[str, ...], label: str | None, limit: int, server: str | None, printer: Printer) -> None:
    """List jobs, the newest first.

    Every command takes the id that is shown, a whole one of the JSON output, or 'last'.
    """
    from octasplat.workers.client.short_ids import list_rows, short_id

    query: dict[str, Any] = {"state": list(state)} if state else {}
    if label is not None:
        query["label"] = label
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
    queues = [(row["queue"], row["waiting"], row["running"], row["slots"]) for row in found["queues"]]
    live = [
        (row["name"], ",".join(row["queues"]), row["slots"], local_time(row["started_at"]))
        for row in found["workers"]
    ]
    lines = [
        *table_lines(("Queue", "Waiting", "Running", "Slots"), queues),
        *(["", *table_lines(("Worker", "Queues", "Slots", "Since"), live)] if live else [_NO_WORKERS]),
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


@click.command(short_help="Queue a failed or cancelled job again.")
@click.argument("job_id", metavar="JOB")
@click.option("--from-start", is_flag=True, help="Not from its checkpoint.")
@exports_option
@set_option
@server_option
@output_options
def retry(job_id: str, from_start: bool, server: str | None, printer: Printer, **given: Any) -> None:
    """Queue JOB again; it goes on from its checkpoint.

    With --exports it writes other files from the scene that is trained; other settings of the training need
    --from-start.
    """
    from octasplat.workers.client.short_ids import find_job

    body: dict[str, Any] = {"from": "start" if from_start else "checkpoint"}
    with connected(server) as api:
        job = find_job(api, job_id)
        if options := _changed_options(given, job):
            body["options"] = options
        job = api.post(f"/v1/jobs/{job['id']}/retry", body)
    printer.print(job, [f"{job['id']}: {job['state']}"])
    for note in job.get("notes", ()):
        click.echo(f"Note: {note}", err=True)


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


def _as_dataset(api: "Api", scene: Path) -> Path:
    """Return the whole id of a dataset that is named by the end of it; a path as it is.

    Raises:
        ConfigError: the path is that of a video.
    """
    from octasplat.engine.dataset.video_frames import is_video
    from octasplat.workers.client.short_ids import SHOWN_CHARACTERS, find_dataset

    if is_video(scene):
        raise ConfigError(
            f"{scene}: photographs are sent, not videos; octasplat reconstruct takes a video and writes the "
            "frames that it chooses beside its results."
        )
    is_short = re.fullmatch(f"[0-9a-f]{{{SHOWN_CHARACTERS}}}", str(scene)) and not scene.exists()
    return Path(find_dataset(api, str(scene))["id"]) if is_short else scene


def _check_output(output: Path | None, *, wait: bool) -> None:
    """Refuse a folder for results that nobody waits for."""
    if output is not None and not wait:
        raise click.UsageError("-o goes with --wait; octasplat download saves the results later.")


def _changed_options(given: dict[str, Any], job: dict[str, Any]) -> dict[str, Any]:
    """Return what is to be otherwise in the options of a job."""
    exports = parse_export_names(given["exports"])
    options: dict[str, Any] = {} if exports is None else {"exports": list(exports)}
    if job["kind"] != "reconstruct":
        # The service replaces an option as a whole, of which a name with dots is only a part.
        sections = {assignment.partition("=")[0].partition(".") for assignment in given["assignments"]}
        known = {name.strip(): job["options"].get(name.strip()) for name, dot, _ in sections if dot}
        result = {name: value for name, value in copy.deepcopy(known).items() if isinstance(value, dict)}
        return _with_assignments(result | options, given["assignments"])
    return options | ({"assignments": list(given["assignments"])} if given["assignments"] else {})


def _parse_file_option(text: str) -> tuple[str, Path]:
    """Return what ``--file`` says: the option, and the file."""
    name, equals, path = text.partition("=")
    if not equals or not path:
        raise ConfigError(f"--file {text}: write it as option=path, e.g. meshes=edited.ply.")
    return name.strip(), Path(path)


def _with_assignments(options: dict[str, Any], assignments: tuple[str, ...]) -> dict[str, Any]:
    """Return the options with ``--set`` on top."""
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals:
            raise ConfigError(f"--set {assignment}: write it as name=value, e.g. q=9.")
        try:
            value = json.loads(text)
        except ValueError:
            value = text
        *path, last = name.strip().split(".")
        section = options
        for part in path:
            section = section.setdefault(part, {})
            if not isinstance(section, dict):
                raise ConfigError(f"--set {assignment}: {part} is no section.")
        section[last] = value
    return options


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
