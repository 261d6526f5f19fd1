"""A folder of photographs, or a ZIP file, to a dataset; what has arrived before is not sent again."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.folder_files import files_below, unreadable_folders_sentence
from octasplat.engine.core.scene_layout import is_ignored_file
from octasplat.workers.client.api import Api
from octasplat.workers.client.dataset_files import (
    LocalFile,
    describe_unsent,
    put_file,
    send_files,
    sha256_of,
)
from octasplat.workers.client.dataset_tasks import create_dataset_once, fill_and_commit
from octasplat.workers.client.resumable_upload import MIN_RESUMABLE_BYTES, send_resumable
from octasplat.workers.client.upload_parts import file_size, unreadable_error

_ARCHIVE_END_BYTES = 1 << 18
"""So much of the end of an archive is shown first; it holds the names of a thousand files."""
_ARCHIVE_END_TRIES = 4
"""The list of contents may ask for more three times: its end record, that of ZIP64, and itself."""


def list_scene_files(
    api: Api, scene: Path, on_warning: Callable[[str], None] = lambda _sentence: None
) -> list[LocalFile]:
    """Return the files of a scene folder that the service takes, by name; what it leaves out is told.

    Raises:
        DatasetError: it is no folder, or the service would refuse it.
        ServiceError: the service cannot be asked.
    """
    if not scene.is_dir():
        raise DatasetError(f"{scene} is not a folder; name the folder that holds the photographs.")
    unreadable: list[Path] = []
    found = sorted(files_below(scene, on_unreadable=unreadable.append))
    if (sentence := unreadable_folders_sentence(unreadable, scene)) is not None:
        on_warning(sentence)
    paths = {_replace_non_utf8(path.relative_to(scene).as_posix()): path for path in found}
    listed = [
        {"path": name, "size_bytes": file_size(path)}
        for name, path in paths.items()
        if not is_ignored_file(name)
    ]
    taken = preview_files(api, str(scene), listed, on_warning)
    files = [LocalFile(file["name"], paths[file["path"]], file["size_bytes"]) for file in taken]
    for file in files:
        if _replace_non_utf8(str(file.path)) != str(file.path):
            raise DatasetError(f"The name of {str(file.path)!a} is not UTF-8; rename the file.")
    return files


def preview_files(
    api: Api, scene: str, listed: Sequence[Mapping[str, Any]], on_warning: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Return which of the listed files the service takes; what it leaves out is told.

    Args:
        api: the service.
        scene: what the files are of, for the error.
        listed: ``path`` and ``size_bytes`` of each file.
        on_warning: called with a sentence on which files are left out.

    Returns:
        ``name`` in the dataset, ``path`` and ``size_bytes`` of each.

    Raises:
        DatasetError: the service would refuse them.
        ServiceError: the service cannot be asked.
    """
    preview = api.post("/v1/scene-previews", {"files": listed})
    _tell_preview(scene, preview, on_warning)
    taken: list[dict[str, Any]] = preview["files"]
    return taken


def _replace_non_utf8(name: str) -> str:
    """Return a name with what is not UTF-8 in it replaced, as JSON cannot hold it."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def _preview_archive(api: Api, archive: Path, on_warning: Callable[[str], None]) -> None:
    """Tell what the service would leave out of a ZIP file, by the list of contents at its end.

    Raises:
        DatasetError: the service would refuse it.
    """
    size, needed = archive.stat().st_size, _ARCHIVE_END_BYTES
    for _ in range(_ARCHIVE_END_TRIES):
        with archive.open("rb") as file:
            file.seek(max(0, size - needed))
            end = file.read()
        headers = {"Content-Type": "application/octet-stream"}
        preview = api.request(
            "POST", f"/v1/scene-previews/archive?size_bytes={size}", content=end, headers=headers
        ).json()
        needed = preview["needed_bytes"]
        if needed is None or needed <= len(end):
            break
    _tell_preview(str(archive), preview, on_warning)


def _tell_preview(scene: str, preview: Mapping[str, Any], on_warning: Callable[[str], None]) -> None:
    for sentence in preview["notes"]:
        on_warning(sentence)
    if preview["refusals"]:
        refusals = " ".join(dict.fromkeys(refusal["detail"] for refusal in preview["refusals"]))
        raise DatasetError(f"{scene} cannot be sent: {refusals}")


def upload_scene(
    api: Api,
    scene: Path,
    *,
    name: str | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
    on_warning: Callable[[str], None] = lambda _sentence: None,
    on_note: Callable[[str], None] = lambda _sentence: None,
) -> dict[str, Any]:
    """Send a scene and commit it; the same command again goes on with the same dataset.

    Of a folder only those files are sent that no dataset of the same owner holds.

    Args:
        api: the service.
        scene: a folder with ``images/``, a bare folder of photographs, or a ZIP file.
        name: what to call it; by default as the folder.
        progress: called with (bytes done, total).
        on_warning: called with a sentence on which files are left out, before anything is sent.
        on_note: called with a sentence on what was not sent, as the service has it.

    Returns:
        The dataset.

    Raises:
        DatasetError: the service would refuse the scene, which is not sent.
        ServiceError: the service refuses it; the text names the files.
    """
    is_archive = scene.is_file()
    if is_archive:
        files = [LocalFile(_replace_non_utf8(scene.name), scene, file_size(scene))]
        _preview_archive(api, scene, on_warning)
    else:
        files = list_scene_files(api, scene, on_warning)
    dataset = _find_or_create_dataset(api, name or _replace_non_utf8(scene.resolve().stem), files)
    if is_archive and dataset["state"] == "open":
        return fill_and_commit(api, dataset, lambda: _send_archive(api, dataset["id"], files[0], progress))
    return _send_folder(api, dataset, files, progress, on_note)


def upload_files(
    api: Api,
    files: Mapping[str, Path],
    *,
    name: str = "",
    progress: Callable[[int, int], None] = lambda _done, _total: None,
    on_note: Callable[[str], None] = lambda _sentence: None,
) -> dict[str, Any]:
    """Send files that the options of a job name; the same call again goes on with the same dataset.

    Args:
        api: the service.
        files: where they are, by the names that the options call them.
        name: what to call the dataset.
        progress: called with (bytes done, total).
        on_note: called with a sentence on what was not sent, as the service has it.

    Returns:
        The dataset, committed; a job gets it as ``files_id``.

    Raises:
        ServiceError: the service refuses it; the text names the files.
    """
    local = [LocalFile(called, path, file_size(path)) for called, path in sorted(files.items())]
    dataset = _find_or_create_dataset(api, name, local, holds="files")
    return _send_folder(api, dataset, local, progress, on_note)


def _find_or_create_dataset(
    api: Api, name: str, files: Iterable[LocalFile], holds: str = "photographs"
) -> dict[str, Any]:
    """Return the dataset that was made for just these files, or a new one."""
    digest = hashlib.sha256(f"{holds}\0{name}".encode() if holds == "files" else name.encode())
    for file in files:
        # In the place of the contents, which would all have to be read first.
        try:
            facts = file.path.stat()
        except OSError as error:
            raise unreadable_error(file.path, error) from None
        digest.update(f"{file.name}\0{facts.st_size}\0{facts.st_mtime_ns}\0{facts.st_ino}\n".encode())
    body = {"name": name[:200]} | ({"holds": holds} if holds == "files" else {})
    return create_dataset_once(api, body, f"scene-{digest.hexdigest()}")


def _send_folder(
    api: Api,
    dataset: dict[str, Any],
    files: Sequence[LocalFile],
    progress: Callable[[int, int], None],
    on_note: Callable[[str], None],
) -> dict[str, Any]:
    """Send the files that are lacking, note those that are not, and commit the dataset; returns it.

    A dataset that is closed has them all.
    """

    def note(unsent: Sequence[LocalFile]) -> None:
        if (sentence := describe_unsent(unsent, len(files))) is not None:
            on_note(sentence)

    if dataset["state"] != "open":
        note(files)
    return fill_and_commit(api, dataset, lambda: note(send_files(api, dataset["id"], files, progress)))


def _send_archive(api: Api, dataset_id: str, file: LocalFile, progress: Callable[[int, int], None]) -> None:
    progress(0, file.size_bytes)
    sha256 = sha256_of(file.path)
    if file.size_bytes >= MIN_RESUMABLE_BYTES:
        send_resumable(api, dataset_id, file.path, None, sha256, lambda done: progress(done, file.size_bytes))
    else:
        put_file(api, f"/v1/datasets/{dataset_id}/archive", file.path, sha256)
    progress(file.size_bytes, file.size_bytes)
