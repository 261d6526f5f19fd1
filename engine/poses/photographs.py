"""Which files of a folder are photographs to find poses for."""

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.scene_layout import (
    FileRole,
    file_role,
    is_ignored_file,
    is_photograph,
    lay_out_scene,
    left_out_sentences,
)
from octasplat.engine.dataset.masks import masks_beside
from octasplat.engine.dataset.results_among import is_run_folder
from octasplat.engine.poses.config import MIN_PHOTOGRAPHS


def photographs_in(folder: Path) -> list[str]:
    """Names of the photographs that poses can be found for, relative to ``folder``, in folders below it too.

    Results of a run among them are no photographs, nor are masks: those in a folder ``masks``, and those
    beside photographs, as ``a_mask.png`` of ``a.jpg``.

    Raises:
        DatasetError: there are fewer than three.
    """
    files = _files_below(folder)
    names = [name for name in files if is_photograph(name)]
    masks = masks_beside(names)
    names = [name for name in names if name not in masks]
    if len(names) < MIN_PHOTOGRAPHS:
        unread = left_out_sentences([name for name in files if not is_photograph(name)])
        formats = (
            f"{folder} holds {len(names)} photographs that poses can be found for (JPEG, PNG, TIFF, BMP, ...)"
        )
        raise DatasetError(" ".join((f"{formats}; at least {MIN_PHOTOGRAPHS} are needed.", *unread)))
    return names


def left_out_of_search(scene: Path) -> tuple[str, ...]:
    """Return sentences on the files of a scene that no poses are looked for.

    Raises:
        DatasetError: a folder below it is the scene, with a model of its own.
    """
    layout = lay_out_scene(_files_below(scene))
    if layout.folder and any(file_role(name) is FileRole.MODEL for name in layout.files):
        raise DatasetError(
            f"{scene} holds a scene with a COLMAP model; name {scene / layout.folder} instead."
        )
    return left_out_sentences(layout.left_out)


def _files_below(folder: Path) -> list[str]:
    """Return files by their paths below ``folder``, sorted, without hidden ones and results of runs."""
    found: list[str] = []
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not is_run_folder(Path(parent) / name)]
        found += ((Path(parent) / name).relative_to(folder).as_posix() for name in names)
    return sorted(name for name in found if not is_ignored_file(name))


def photographs_sha256(folder: Path, names: Sequence[str]) -> str:
    """A digest of the photographs' names and contents."""
    digest = hashlib.sha256()
    for name in names:
        digest.update(f"{name}\0{(folder / name).stat().st_size}\n".encode())
        with (folder / name).open("rb") as content:
            digest.update(hashlib.file_digest(content, "sha256").digest())
    return digest.hexdigest()
