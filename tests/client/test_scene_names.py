"""Folders and ZIP files with unusual names, which become the names of datasets."""

import json
import os
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.poses.photographs import notes_on_files
from octasplat.workers.client.api import Api
from octasplat.workers.client.submission import Submission, submit
from octasplat.workers.client.upload import upload_scene
from tests.support.scripted_front import Answer, Front, as_json, serve

__all__ = ["serve"]

MAX_NAME = 200
"""Of a dataset, in characters."""


class Scenes:
    """A service that takes any scene as it is, and remembers what it was asked for."""

    def __init__(self) -> None:
        self.made: list[dict[str, Any]] = []

    def __call__(self, method: str, path: str, _headers: dict[str, str], body: bytes) -> Answer:
        if path.startswith("/v1/scene-previews/archive"):
            return as_json({"notes": [], "refusals": [], "needed_bytes": None})
        if path == "/v1/scene-previews":
            files = [{**file, "name": f"images/{file['path']}"} for file in json.loads(body)["files"]]
            return as_json({"files": files, "notes": [], "refusals": []})
        if path in ("/v1/datasets", "/v1/jobs"):
            self.made.append(json.loads(body))
            if len(self.made[-1].get("name", "")) > MAX_NAME:
                return as_json({"detail": "The name is too long."}, 422)
        if "/files" in path:
            return as_json({"files": [], "next": None})
        state = "committed" if path.endswith("/commit") else "open"
        return as_json({"id": "d", "state": state, "facts": {}})


def test_scene_whose_name_is_longer_than_that_of_a_dataset_is_sent(
    serve: Callable[..., Front], tmp_path: Path
) -> None:
    folder = tmp_path / ("n" * 250)
    folder.mkdir()
    (folder / "a.jpg").write_bytes(b"x")
    service = Scenes()
    with Api(serve(service).address) as api:
        upload_scene(api, folder)
    assert service.made[0]["name"] == "n" * MAX_NAME


def test_zip_file_whose_name_is_no_utf_8_is_sent(serve: Callable[..., Front], tmp_path: Path) -> None:
    archive = Path(os.fsdecode(os.fsencode(tmp_path) + b"/Stra\xdfe.zip"))
    archive.write_bytes(b"x")
    service = Scenes()
    with Api(serve(service).address) as api:
        upload_scene(api, archive)
    assert service.made[0]["name"] == "Stra\N{REPLACEMENT CHARACTER}e"


def test_folder_that_is_named_by_a_digest_is_sent(
    serve: Callable[..., Front], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not taken for the id of a dataset, which is written with dashes."""
    name = "0123456789abcdef" * 2
    (tmp_path / name).mkdir()
    (tmp_path / name / "a.jpg").write_bytes(b"x")
    monkeypatch.chdir(tmp_path)
    service = Scenes()
    with Api(serve(service).address) as api:
        submit(api, Submission(Path(name)))
        assert [made.get("name") for made in service.made] == [name, None]
        whole = str(uuid.UUID(name))
        submit(api, Submission(whole))
    assert [made.get("dataset_id") for made in service.made] == [None, "d", whole]


def test_folder_that_cannot_be_read_is_told(
    serve: Callable[..., Front], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When a scene is sent, and when it is reconstructed here."""
    for folder in ("images/left", "images/right", ".Trash"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "a.jpg").write_bytes(b"x")
    list_folder, warnings = Path.iterdir, list[str]()

    def refuse_right(folder: Path) -> Any:
        if folder.name in ("right", ".Trash"):
            raise PermissionError(13, "Permission denied")
        return list_folder(folder)

    monkeypatch.setattr(Path, "iterdir", refuse_right)
    with Api(serve(Scenes()).address) as api:
        upload_scene(api, tmp_path, on_warning=warnings.append)
    expected = "Files in folders that cannot be read are left out (images/right)."
    assert warnings == [expected] and expected in notes_on_files(tmp_path)


def test_file_that_goes_while_a_scene_is_listed_is_told(
    serve: Callable[..., Front], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.jpg").write_bytes(b"x")
    (tmp_path / "b.jpg").write_bytes(b"x")
    service = Scenes()

    def answer(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        (tmp_path / "b.jpg").unlink(missing_ok=True)  # once it was listed
        return service(method, path, headers, body)

    with Api(serve(answer).address) as api, pytest.raises(DatasetError, match=r"b\.jpg cannot be read"):
        upload_scene(api, tmp_path)
