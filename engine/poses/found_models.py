"""Folders of found models: the one that is taken, and others beside it where photographs fall apart.

The model that is taken lies in the folder itself, every other one in a folder below that is called by its
number: ``0`` for the one of most photographs, then ``1`` and so on. ``poses.json`` is beside the files of
each. Another one is taken by :func:`choose_found_model`; what was taken before gets a folder below then.
"""

import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octasplat.engine.core import versions
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.name_lists import name_list
from octasplat.engine.core.writing import replace_folder, write_json
from octasplat.engine.poses.config import RECORD_FILE

_FOUND_MODEL = re.compile(r"(?:(?P<folder>.*)/)?poses/(?P<number>\d+)/?")
"""How one of the models that a search has found is called, with the folder of a run before it or without."""
_OF_SEARCH = ("photographs_sha256", versions.STATED)
_OF_TAKEN_ONLY = ("number", "other_models", *_OF_SEARCH)
"""What only the record of the model that is taken says."""
_MAX_DESCRIBED = 8


@dataclass(frozen=True)
class OtherModel:
    """A found model that is not the one taken.

    Attributes:
        number: of it.
        folder: of its files.
        placed: how many photographs it has.
        names: of those that the one taken lacks.
    """

    number: int
    folder: Path
    placed: int
    names: tuple[str, ...]


def read_pose_record(poses: Path) -> dict[str, Any]:
    """Return the record of estimated poses and their photographs; empty if there is none."""
    try:
        record: dict[str, Any] = json.loads((poses / RECORD_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record


def parse_found_model(name: str | None) -> tuple[Path | None, int] | None:
    """Return the folder of the run, if it is named, and the number of a found model; None for other names.

    >>> parse_found_model("out/poses/1"), parse_found_model("poses/2"), parse_found_model("sparse/1")
    ((PosixPath('out'), 1), (None, 2), None)
    """
    found = None if name is None else _FOUND_MODEL.fullmatch(name.replace("\\", "/"))
    if found is None:
        return None
    folder = found["folder"]
    return None if folder is None else Path(folder or "/"), int(found["number"])


def other_models(poses: Path) -> list[OtherModel]:
    """Return the found models that are not the one taken, in the order of their numbers."""
    record = read_pose_record(poses)
    lacking = set(record.get("left_out", ()))
    found = []
    for number, folder in sorted(_numbered_folders(poses).items()):
        own = read_pose_record(folder)
        names = sorted(lacking - set(own.get("left_out", ())))
        found.append(OtherModel(number, folder, int(own.get("placed", 0)), tuple(names)))
    return found


def describe_other_models(poses: Path) -> str | None:
    """Return what a user is told of the models that are not taken; None where there are none."""
    others, taken = other_models(poses), read_pose_record(poses).get("placed")
    if not others:
        return None
    each = [
        f"{model.folder} of {model.placed} photographs, {len(model.names)} of them not in that one "
        f"({name_list(model.names)})"
        for model in others[:_MAX_DESCRIBED]
    ]
    each += [f"{len(others) - _MAX_DESCRIBED} more beside these"] * (len(others) > _MAX_DESCRIBED)
    return (
        f"The photographs fall apart into {len(others) + 1} models that no matches link: that of {taken} "
        f"photographs is taken. Left are {'; '.join(each)}. Photographs that show both places link them; "
        f"--model {others[0].folder} trains that one in a run of its own."
    )


def write_other_models(poses: Path) -> None:
    """Write into the record of the model that is taken which others there are."""
    others = [
        {"folder": model.folder.name, "placed": model.placed, "not_in_taken": list(model.names)}
        for model in other_models(poses)
    ]
    record = {name: value for name, value in read_pose_record(poses).items() if name != "other_models"}
    write_json(poses / RECORD_FILE, {**record, **({"other_models": others} if others else {})})


def choose_found_model(poses: Path, number: int) -> None:
    """Let the model of a number be the one that is taken.

    Raises:
        DatasetError: there is none of this number.
    """
    record = read_pose_record(poses)
    taken = record.get("number", 0)
    if number == taken:
        return
    folders = _numbered_folders(poses)
    if number not in folders:
        there = name_list([f"poses/{known}" for known in sorted({taken, *folders})], len(folders) + 1)
        raise DatasetError(
            f"The search has found no model poses/{number}; {there} {'are' if folders else 'is all that is'} "
            "there."
        )
    new = poses.with_name(f".{poses.name}.chosen")
    shutil.rmtree(new, ignore_errors=True)
    shutil.copytree(poses, new)
    before = new / str(taken)
    before.mkdir()
    for path in _model_files(new):
        path.rename(before / path.name)
    write_json(before / RECORD_FILE, {key: record[key] for key in record if key not in _OF_TAKEN_ONLY})
    for path in _model_files(new / str(number)):
        path.rename(new / path.name)
    (new / str(number)).rmdir()
    shared = {name: record[name] for name in _OF_SEARCH if name in record}
    write_json(new / RECORD_FILE, {**read_pose_record(new), "number": number, **shared})
    write_other_models(new)
    replace_folder(poses, new)


def copy_found_models(source: Path, target: Path) -> None:
    """Copy a folder of found models; what is copied is whole or is not there."""
    work = target.with_name(f".{target.name}.copied")
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(source, work)
    work.rename(target)


def keep_other_models(poses: Path, new: Path) -> None:
    """Put the models of ``poses`` that are not the one taken into ``new``, which will have its place."""
    for number, folder in _numbered_folders(poses).items():
        shutil.copytree(folder, new / str(number))


def _numbered_folders(poses: Path) -> dict[int, Path]:
    """Return the folders of the models that are not taken, by number."""
    return {
        int(path.name): path
        for path in (poses.iterdir() if poses.is_dir() else ())
        if path.name.isdecimal() and (path / RECORD_FILE).is_file()
    }


def _model_files(folder: Path) -> Sequence[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file())
