"""Which files of a folder are photographs to find poses for."""

import hashlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset.masks import masks_beside
from octasplat.engine.dataset.results_among import is_run_folder
from octasplat.engine.poses.config import MIN_PHOTOGRAPHS

_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})


def photographs_in(folder: Path) -> list[str]:
    """Names of the photographs that poses can be found for, relative to ``folder``.

    Those in folders below count only where ``folder`` is called ``images``; below a bare folder there may be
    anything, masks and results among it. Results of a run within ``images`` are no photographs either, nor
    are masks beside photographs, as ``a_mask.png`` of ``a.jpg``.

    Raises:
        DatasetError: there are fewer than three.
    """
    below = _files_below(folder) if folder.name == "images" else folder.glob("*")
    names = sorted(
        path.relative_to(folder).as_posix()
        for path in below
        if path.suffix.lower() in _SUFFIXES and path.is_file() and not path.name.startswith(".")
    )
    masks = masks_beside(names)
    names = [name for name in names if name not in masks]
    if len(names) < MIN_PHOTOGRAPHS:
        raise DatasetError(
            f"{folder} holds {len(names)} photographs that poses can be found for (JPEG, PNG, TIFF, BMP); "
            f"at least {MIN_PHOTOGRAPHS} are needed."
        )
    return names


def _files_below(folder: Path) -> Iterator[Path]:
    for parent, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not is_run_folder(Path(parent) / name)]
        yield from (Path(parent) / name for name in names)


def photographs_sha256(folder: Path, names: Sequence[str]) -> str:
    """A digest of the photographs' names and contents."""
    digest = hashlib.sha256()
    for name in names:
        digest.update(f"{name}\0{(folder / name).stat().st_size}\n".encode())
        with (folder / name).open("rb") as content:
            digest.update(hashlib.file_digest(content, "sha256").digest())
    return digest.hexdigest()
