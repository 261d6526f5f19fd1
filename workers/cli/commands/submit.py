"""Commands that queue work at a service: submit, derive and retry."""

import copy
import json
import re
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.operations.block_options import check_block_options
from octasplat.engine.operations.reconstruct import ReconstructOptions
from octasplat.engine.settings.renamed_settings import notify_renamed
from octasplat.workers.cli.options import exports_option, parse_export_names
from octasplat.workers.cli.printing import Printer, output_options
from octasplat.workers.cli.request_options import request_from_options, request_options
from octasplat.workers.cli.service_options import (
    SceneName,
    connected,
    job_options,
    server_option,
    set_option,
    wait_options,
)

if TYPE_CHECKING:
    from octasplat.workers.client.api import Api


@click.command(short_help="Send photographs to the service and queue their reconstruction.")
@click.argument("scene", metavar="[PHOTOS]", type=SceneName(), required=False)
@click.option(
    "--sha256",
    metavar="HEX",
    help="Where PHOTOS is an address: what the ZIP file must be; then it is fetched once only.",
)
@click.option(
    "--start-from",
    metavar="JOB",
    help="Begin with the Gaussians of that reconstruction, finished or stopped; without PHOTOS on its "
    "photographs.",
)
@wait_options
@request_options(ReconstructOptions)
@job_options
@output_options
def submit(
    scene: Path | str | None,
    sha256: str | None,
    start_from: str | None,
    wait: bool,
    output: Path | None,
    label: str | None,
    queue: str,
    priority: int,
    server: str | None,
    printer: Printer,
    **given: Any,
) -> None:
    """Send PHOTOS: a folder with images/ (and sparse/0), one of photographs, a ZIP file or a dataset's id.

    The same command goes on with an upload that broke off. The service itself fetches a ZIP file from a
    public https address: octasplat submit https://example.org/fox.zip
    So it does with photographs in a bucket of yours: octasplat submit s3://bucket/fox

    With --start-from a training goes on from where another is, with other options:
    octasplat submit --start-from last --preset high
    """
    from octasplat.workers.cli.remote_jobs import submit, submit_and_wait
    from octasplat.workers.client.short_ids import find_job
    from octasplat.workers.client.submission import Submission

    _check_output(output, wait=wait)
    if scene is None and start_from is None:
        raise click.UsageError("Name PHOTOS, or a job by --start-from, whose photographs are taken.")
    options: ReconstructOptions = request_from_options(ReconstructOptions, given)
    check_block_options(options, options.config())  # what cannot be used is refused before anything is sent
    requested = options.model_dump(mode="json", exclude_unset=True)
    what = Submission(scene, requested, label, queue, priority, sha256)
    with connected(server, awaits_start=True) as api:
        if scene is not None:
            what = replace(what, scene=_as_dataset(api, scene))
        if start_from is not None:
            what = replace(what, start_from=str(find_job(api, start_from)["id"]))
        if wait:
            submit_and_wait(api, what, output or Path(f"{_stem(scene or 'scene')}-result"), printer)
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
    type=SceneName(),
    metavar="DATASET",
    help="Evaluate: measure all photographs of this folder, ZIP file, dataset or address in the same world "
    "instead.",
)
@click.option("--on", "former_on", type=click.Path(path_type=Path), hidden=True)
@set_option
@wait_options
@job_options
@output_options
def derive(
    kind: str,
    job_id: str | None,
    stage: Path | None,
    path_file: Path | None,
    environments: tuple[Path, ...],
    other_dataset: Path | str | None,
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
    from octasplat.workers.cli.remote_jobs import submit, submit_and_wait
    from octasplat.workers.client.short_ids import find_job
    from octasplat.workers.client.submission import (
        Derivation,
        with_camera_path,
        with_environments,
        with_stage,
    )

    _check_output(output, wait=wait)
    if former_on is not None:
        if other_dataset is not None:
            raise click.UsageError("--on is the former name of --other-dataset; give one of the two.")
        notify_renamed({"--on": "--other-dataset"})
    files = [_parse_file_option(text) for text in given["files"]]
    with connected(server, awaits_start=wait) as api:
        source = None if job_id is None else find_job(api, job_id)["id"]
        photographs = other_dataset or former_on
        what = Derivation(
            source,
            kind,
            _with_assignments({}, given["set"]),
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
        job = submit(api, what, printer)
    printer.print(job, [job["id"]], quiet_lines=[job["id"]])


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


def _stem(scene: Path | str) -> str:
    """Return what to call the results of a scene."""
    path = PurePosixPath(urlsplit(scene).path) if isinstance(scene, str) else scene
    return path.stem or "scene"


def _as_dataset(api: "Api", scene: Path | str) -> Path | str:
    """Return the whole id of a dataset that is named by the end of it; a path or address as it is.

    Raises:
        ConfigError: the path is that of a video.
    """
    if isinstance(scene, str):
        return scene
    from octasplat.engine.dataset.video_frames import is_video
    from octasplat.workers.client.short_ids import SHOWN_CHARACTERS, find_dataset

    if is_video(scene):
        raise ConfigError(
            f"{scene}: photographs are sent, not videos; octasplat reconstruct takes a video and writes the "
            "frames that it chooses beside its results."
        )
    # Eight hexadecimal digits may be the name of a folder as well.
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
        sections = {assignment.partition("=")[0].partition(".") for assignment in given["set"]}
        known = {name.strip(): job["options"].get(name.strip()) for name, dot, _ in sections if dot}
        result = {name: value for name, value in copy.deepcopy(known).items() if isinstance(value, dict)}
        return _with_assignments(result | options, given["set"])
    return options | ({"set": list(given["set"])} if given["set"] else {})


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
        # What is no JSON is text, so that words need no quotes in a shell.
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
