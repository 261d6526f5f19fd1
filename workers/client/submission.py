"""From a folder to results: upload, queue, wait, download."""

import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from pathlib import Path, PurePosixPath
from typing import Any

from octasplat.engine.core.errors import ConfigError, OctasplatError
from octasplat.engine.core.events import EventListener, Noted, Warned, ignore_events
from octasplat.engine.core.portable_names import name_or
from octasplat.engine.core.progress import counted_phase
from octasplat.engine.pathtracing.stage.sidecar_files import sidecar_files
from octasplat.engine.pathtracing.stage.stage_file import (
    glass_meshes,
    read_stage,
    referenced_files,
    with_renamed_files,
)
from octasplat.engine.render.path_document import read_path_document
from octasplat.engine.settings.nested_options import merge_options
from octasplat.workers.client.api import Api, ServiceError
from octasplat.workers.client.bucket import import_bucket, is_bucket_address
from octasplat.workers.client.dataset_tasks import import_dataset, is_web_address
from octasplat.workers.client.download import download_archive, download_results
from octasplat.workers.client.upload import upload_files, upload_scene
from octasplat.workers.client.watch import watch_job


class JobFailedError(OctasplatError):
    """The job ended without a result."""

    error_type = "job_failed"


@dataclass(frozen=True)
class Submission:
    """Description of a job to submit.

    Attributes:
        scene: folder of photographs, ZIP file, the id of a dataset, or as text the address of a ZIP file, or
            of a folder in a bucket; None takes the photographs of ``start_from``.
        options: of the reconstruction.
        label: what to call the job.
        queue: which workers.
        priority: higher goes first.
        sha256: what the ZIP file at an address must be.
        start_from: the reconstruction, finished or stopped, with whose Gaussians it begins; its id.
    """

    scene: Path | str | None
    options: Mapping[str, Any] = field(default_factory=dict)
    label: str | None = None
    queue: str = "cpu"
    priority: int = 0
    sha256: str | None = None
    start_from: str | None = None


def submit(api: Api, submission: Submission, on_event: EventListener = ignore_events) -> dict[str, Any]:
    """Upload what is missing and queue the job; returns the job.

    Args:
        api: the service.
        submission: the scene and what to do with it.
        on_event: receives the stage ``upload``, whose steps are kB, what was not sent, and what the service
            warns of.

    Raises:
        OctasplatError: the scene or the options are refused, or the service does not answer.
    """
    body: dict[str, Any] = {
        "options": dict(submission.options),
        "label": submission.label,
        "queue": submission.queue,
        "priority": submission.priority,
    }
    if submission.start_from is not None:
        body["source_id"] = submission.start_from
    if submission.scene is not None:
        _check_options(api, "reconstruct", submission.options, submission.queue)
        body["dataset_id"] = _upload_if_needed(api, submission.scene, on_event, submission.sha256)
    job: dict[str, Any] = api.post("/v1/jobs", body)
    return job


def _check_options(api: Api, kind: str, options: Mapping[str, Any], queue: str) -> None:
    """Let options be refused before anything is sent, which may take hours; others show when the job is made.

    Raises:
        ServiceError: the service refuses them.
        ServiceUnreachableError: it does not answer.
    """
    try:
        api.post("/v1/estimates", {"kind": kind, "options": dict(options), "queue": queue})
    except ServiceError as error:
        if error.status == HTTPStatus.UNPROCESSABLE_ENTITY:
            raise


@dataclass(frozen=True)
class Derivation:
    """A job on the results of a finished one, or on files.

    Attributes:
        source_id: the finished job; None for kinds that work on files alone.
        kind: of the job, such as ``render``; GET /v1/options has them.
        options: of the kind.
        files: files that the options name, by these names.
        scene: photographs to work on instead of the finished job's: as those of :class:`Submission`.
        label: what to call the job.
        queue: which workers.
        priority: higher goes first.
    """

    source_id: str | None
    kind: str
    options: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, Path] = field(default_factory=dict)
    scene: Path | str | None = None
    label: str | None = None
    queue: str = "cpu"
    priority: int = 0


def with_stage(derivation: Derivation, stage: Path) -> Derivation:
    """Return the same with a stage and the files that it names; options that say otherwise win.

    Files that lie elsewhere than in or below the stage's folder, or whose names a service does not take, are
    sent under other ones.

    Raises:
        ConfigError: the stage cannot be used, a file that it names is not there, or a mesh that is to be
            glass is not closed.
        SceneFileError: a mesh that is to be glass cannot be read.
    """
    read = read_stage(stage)
    if glass := glass_meshes(read):
        # The readers of meshes take a while to import, which other stages do not need.
        from octasplat.engine.pathtracing.mesh_files import check_glass_is_closed

        check_glass_is_closed(glass, stage.parent)
    names: dict[str, str] = {}
    for _, name in referenced_files(read):
        names[name] = name_or(name, f"elsewhere/{len(names)}/{Path(name).name}")
    files = {sent: stage.parent / name for name, sent in names.items()}
    for sent, path in tuple(files.items()):
        for beside in sidecar_files(path):
            files[(PurePosixPath(sent).parent / beside).as_posix()] = path.parent / beside
    stage_options = {"stage": with_renamed_files(read, names).model_dump(mode="json")}
    return replace(
        derivation,
        options=merge_options(stage_options, derivation.options),
        files={**derivation.files, **files},
    )


def with_camera_path(derivation: Derivation, path: Path) -> Derivation:
    """Return the same with the cameras of a path file, whose content goes into the options.

    Options that say otherwise win, as another ``camera_path.fps``.

    Raises:
        ConfigError: the file cannot be read, or is no camera path.
    """
    document = read_path_document(path).model_dump(mode="json", exclude_none=True)
    return replace(
        derivation, options=merge_options({"mode": "path", "camera_path": document}, derivation.options)
    )


def with_environments(derivation: Derivation, maps: Sequence[Path]) -> Derivation:
    """Add environment maps, sent under their own names, or plain ones where those are not valid.

    Raises:
        ConfigError: one is not there, or two have one name.
    """
    files: dict[str, Path] = {}
    for path in maps:
        if not path.is_file():
            raise ConfigError(f"{path}: there is no such file; name an HDR or EXR image.")
        name = name_or(path.name, f"map_{len(files)}{path.suffix.lower()}")
        if name in files:
            raise ConfigError(f"{path}: two environments are called {name}; rename one.")
        files[name] = path
    return replace(
        derivation,
        options={**derivation.options, "environments": list(files)},
        files={**derivation.files, **files},
    )


def derive(api: Api, derivation: Derivation, on_event: EventListener = ignore_events) -> dict[str, Any]:
    """Send the files that the options name, and queue a job on the results of another or on them.

    Returns the job.

    Raises:
        ConfigError: a file is not there.
        ServiceError: something is refused.
        ServiceUnreachableError: the service does not answer.
    """
    # Before anything is sent.
    for path in derivation.files.values():
        if not path.is_file():
            raise ConfigError(f"{path}: there is no such file.")
    body: dict[str, Any] = {
        "kind": derivation.kind,
        "options": dict(derivation.options),
        "label": derivation.label,
        "queue": derivation.queue,
        "priority": derivation.priority,
    }
    if derivation.source_id is not None:
        body["source_id"] = derivation.source_id
    if derivation.scene is not None or derivation.files:
        _check_options(api, derivation.kind, derivation.options, derivation.queue)
    if derivation.scene is not None:
        body["dataset_id"] = _upload_if_needed(api, derivation.scene, on_event)
    if derivation.files:
        with counted_phase("upload", on_event) as progress:
            sent = upload_files(
                api,
                derivation.files,
                name="stage",
                progress=lambda d, t: progress(d >> 10, t >> 10),
                on_note=lambda sentence: on_event(Noted(sentence)),
            )
        body["files_id"] = sent["id"]
    job: dict[str, Any] = api.post("/v1/jobs", body)
    return job


def wait_for_job(
    api: Api,
    job_id: str,
    on_event: EventListener = ignore_events,
    on_note: Callable[[str], None] = lambda _note: None,
) -> dict[str, Any]:
    """Follow a job until it is over; returns it.

    Args:
        api: the service.
        job_id: which.
        on_event: receives the events of the engine.
        on_note: called with a sentence when another worker takes the job over.

    Raises:
        JobFailedError: it failed or was cancelled.
    """

    def on_state(event: dict[str, Any]) -> None:
        note = {
            "rescued": "The worker was lost; another one goes on.",
            "handed_back": "The worker stops; another one goes on.",
            "blocks_queued": f"The scene is trained in {event.get('blocks')} blocks.",
            "block_finished": f"Block {event.get('block')} is trained, {event.get('left')} to go.",
            "resumed": f"Going on from step {event.get('step')} of {event.get('stage')}.",
        }.get(event["kind"])
        if note is not None:
            on_note(note)

    job = watch_job(api, job_id, on_event, on_state)
    if job["state"] == "failed":
        raise JobFailedError(f"The job failed: {job['error']['message']} (octasplat logs {job_id} says more)")
    if job["state"] == "canceled":
        raise JobFailedError("The job was cancelled; octasplat retry goes on with it.")
    return job


def download_job(
    api: Api, job_id: str, folder: Path, names: tuple[str, ...] = (), on_event: EventListener = ignore_events
) -> tuple[Path, ...]:
    """Save the results of a job, or only those called ``names``; returns the files.

    The stage ``download``, whose steps are kB, is told to ``on_event``.
    """
    with counted_phase("download", on_event) as progress:
        return tuple(
            download_results(
                api, job_id, folder, names=names, progress=lambda d, t: progress(d >> 10, t >> 10)
            )
        )


def download_job_archive(api: Api, job_id: str, path: Path, on_event: EventListener = ignore_events) -> Path:
    """Save all results of a job as one ZIP file; returns it.

    The stage ``download`` is told to ``on_event``.
    """
    with counted_phase("download", on_event) as progress:
        return download_archive(api, job_id, path, progress=lambda d, t: progress(d >> 10, t >> 10))


def _upload_if_needed(api: Api, scene: Path | str, on_event: EventListener, sha256: str | None = None) -> str:
    """Return the dataset of these photographs, sent or fetched if that is not done yet."""
    dataset_id = _parse_id(str(scene))
    if dataset_id is not None:
        return dataset_id
    if isinstance(scene, str) and is_web_address(scene):
        on_event(Noted(f"The service fetches {scene}."))
        return _id_with_notes(import_dataset(api, scene, sha256=sha256), on_event)
    if isinstance(scene, str) and is_bucket_address(scene):
        on_event(Noted(f"The service fetches {scene}."))
        with counted_phase("upload", on_event) as progress:
            dataset = import_bucket(
                api,
                scene,
                sha256=sha256,
                progress=lambda d, t: progress(d >> 10, t >> 10),
                on_warning=lambda sentence: on_event(Warned(sentence)),
            )
        return _id_with_notes(dataset, on_event)
    with counted_phase("upload", on_event) as progress:
        dataset = upload_scene(
            api,
            Path(scene),
            progress=lambda d, t: progress(d >> 10, t >> 10),
            on_warning=lambda sentence: on_event(Warned(sentence)),
            on_note=lambda sentence: on_event(Noted(sentence)),
        )
    return _id_with_notes(dataset, on_event)


def _id_with_notes(dataset: dict[str, Any], on_event: EventListener) -> str:
    """Return the id of a dataset whose warnings are told."""
    for warning in dataset["facts"].get("warnings", ()):
        on_event(Warned(warning))
    return str(dataset["id"])


def _parse_id(text: str) -> str | None:
    """Return the id of a dataset that a text is; None where it is none, or the name of a folder."""
    try:
        dataset_id = str(uuid.UUID(text))
    except ValueError:
        return None
    # Without its dashes an id may be the name of a folder as well, as a digest is.
    return None if text.lower() != dataset_id and Path(text).exists() else dataset_id
