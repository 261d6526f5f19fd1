"""Selection of the files of a folder that are photographs to find poses for."""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.folder_files import files_below, unreadable_folders_sentence
from octasplat.engine.core.portable_names import unportable_names_sentence
from octasplat.engine.core.scene_layout import (
    IMAGES,
    SceneLayout,
    is_ignored_file,
    lay_out_scene,
    masks_beside,
    too_few_photographs,
)
from octasplat.engine.dataset.model_sources import has_model
from octasplat.engine.dataset.photograph_files import image_folder, no_folder_sentence
from octasplat.engine.dataset.results_among import is_run_folder

_POSE_PROPERTIES = (b"xcr:Rotation", b"xcr:Position")
"""Of the XMP files in which RealityScan, formerly RealityCapture, keeps poses."""
_MAX_SIDECAR_BYTES = 1 << 20


def locate_scene(folder: Path) -> Path:
    """Return the scene that ``folder`` is, or the one below it where there is nothing beside that.

    Raises:
        DatasetError: it is no folder, or that of a run.
    """
    _check_folder(folder)
    inner = folder / _layout_of(folder).folder
    return inner if image_folder(inner) != inner or has_model(inner) else folder


def photographs_of_scene(scene: Path) -> list[str]:
    """Return the names of a scene's photographs, relative to its folder of photographs.

    Results of a run among them are no photographs, nor are masks: those in a folder ``masks``, and those
    beside photographs, as ``a_mask.png`` of ``a.jpg``.

    Raises:
        DatasetError: it is no folder, or that of a run, or there are fewer than three; the text names what is
            left out.
    """
    _check_folder(scene)
    layout, folder = _layout_of(scene), image_folder(scene)
    images = {name: path for name, path in layout.files.items() if name.startswith(IMAGES)}
    masks = masks_beside(images)
    names = sorted(
        (scene / path).relative_to(folder).as_posix() for name, path in images.items() if name not in masks
    )
    if (fault := too_few_photographs(len(names))) is not None:
        raise DatasetError(" ".join((f"{scene}: {fault}", *_layout_with_sidecars(scene).notes)))
    return names


def notes_on_files(scene: Path) -> tuple[str, ...]:
    """Return sentences on the files of a folder that are left out, or bear names that others refuse."""
    unreadable: list[Path] = []
    layout = _layout_with_sidecars(scene, unreadable.append)
    others = unreadable_folders_sentence(unreadable, scene), unportable_names_sentence(layout.files)
    return (*layout.notes, *(sentence for sentence in others if sentence is not None))


def _check_folder(scene: Path) -> None:
    if not scene.is_dir():
        raise DatasetError(no_folder_sentence(scene))
    if is_run_folder(scene) and image_folder(scene) == scene:  # its renders would be taken for photographs
        raise DatasetError(
            f"{scene} is the folder of a run; name the folder that holds the photographs it was made of."
        )


def _layout_of(scene: Path) -> SceneLayout:
    return lay_out_scene(_files_below(scene))


def _layout_with_sidecars(
    scene: Path, on_unreadable: Callable[[Path], None] = lambda _folder: None
) -> SceneLayout:
    """Return the layout, with notes that know what XMP files hold."""
    files = _files_below(scene, on_unreadable)
    return lay_out_scene(files, lambda path: _holds_poses(scene / path))


def _holds_poses(sidecar: Path) -> bool:
    """Return whether an XMP file beside a photograph holds a pose, as those of RealityScan do."""
    try:
        with sidecar.open("rb") as file:
            content = file.read(_MAX_SIDECAR_BYTES)
    except OSError:
        return False
    return any(name in content for name in _POSE_PROPERTIES)


def _files_below(folder: Path, on_unreadable: Callable[[Path], None] = lambda _folder: None) -> list[str]:
    """Return files by their paths below ``folder``, sorted, without hidden ones."""
    found = (path.relative_to(folder).as_posix() for path in files_below(folder, on_unreadable=on_unreadable))
    return sorted(name for name in found if not is_ignored_file(name))


def photographs_sha256(folder: Path, names: Sequence[str]) -> str:
    """Return a SHA-256 over the names and contents of the photographs."""
    digest = hashlib.sha256()
    for name in names:
        # names and sizes first, so that contents cannot run into each other
        digest.update(f"{name}\0{(folder / name).stat().st_size}\n".encode())
        with (folder / name).open("rb") as content:
            digest.update(hashlib.file_digest(content, "sha256").digest())
    return digest.hexdigest()
