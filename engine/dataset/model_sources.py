"""Where a scene keeps the poses of its photographs: COLMAP models by their folders, or transforms files."""

import json
from pathlib import Path

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.name_lists import name_list
from octasplat.engine.core.scene_layout import POSE_RECORD
from octasplat.engine.dataset.colmap_reading import MODEL_FILES
from octasplat.engine.dataset.transforms_file import transforms_file

MODEL_FOLDERS = ("sparse", "colmap/sparse", "distorted/sparse", "")
"""Where a scene keeps its model, or several in numbered folders below; the first that holds one counts."""
_SEARCH_DEPTH = 4
_MAX_NAMES = 5


def find_model(root: Path, chosen: str | None = None) -> Path:
    """Return the folder of a scene's COLMAP model, or its transforms file.

    That is the model of most images in the first of :data:`MODEL_FOLDERS` that holds one, else the transforms
    file.

    Args:
        root: folder of the scene.
        chosen: the model to take instead: its path below ``root``, or its number.

    Raises:
        DatasetError: there is none, it lacks a file, or the chosen one is not there.
    """
    if chosen is not None:
        return _chosen_model(root, chosen)
    for name in MODEL_FOLDERS:
        if models := _models_in(root, name):
            complete = [folder for folder in models if not _missing_files(folder)]
            numbered = [folder for folder in complete if folder.name.isdigit()]
            if complete:
                return max(numbered or complete, key=posed_image_count)
            missing = " and ".join(_missing_files(models[0]))
            raise DatasetError(f"{models[0]} lacks {missing}; copy the whole COLMAP model there.")
    if (file := transforms_file(root)) is not None:
        return file
    found = _models_elsewhere(root)
    verb = "is" if len(found) == 1 else "are"
    described = f" {name_list(found, _MAX_NAMES)} {verb} there; name the folder above as the scene."
    raise DatasetError(
        f"{root} holds no COLMAP model; put cameras, images and points3D (.bin or .txt) into "
        f"{root / 'sparse/0'}, or have the poses found: octasplat reconstruct with --poses auto, or "
        f"octasplat submit.{described * bool(found)}"
    )


def is_changed_model(folder: Path) -> bool:
    """Return whether a model that a run keeps is that given for it, with some poses or lenses changed."""
    try:
        record = json.loads((folder / POSE_RECORD).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    # a model that was found states its photographs
    return (
        isinstance(record, dict)
        and "photographs_sha256" not in record
        and ("moved" in record or "lenses" in record)
    )


def has_model(root: Path) -> bool:
    """Return whether the scene brings poses, or at least a part of a COLMAP model."""
    return any(_models_in(root, name) for name in MODEL_FOLDERS) or transforms_file(root) is not None


def other_models(root: Path, taken: Path) -> dict[str, int | None]:
    """Return the models of a scene that are not taken, by their paths below it.

    Each comes with the count of its images, None for a transforms file.
    """
    found: dict[str, int | None] = {}
    for name in MODEL_FOLDERS:
        models = _models_in(root, name)
        # COLMAP's numbered models may lie in a folder that holds one of them again.
        numbered = [model for model in models if model.name.isdigit()]
        for model in numbered or models:
            found[model.relative_to(root).as_posix()] = posed_image_count(model)
    if (file := transforms_file(root)) is not None:
        found[file.name] = None
    if taken.is_relative_to(root):
        found.pop(taken.relative_to(root).as_posix(), None)
    return found


def posed_image_count(folder: Path) -> int:
    """Return how many images a model announces; 0 where that cannot be read."""
    try:
        if (folder / "images.bin").is_file():
            with (folder / "images.bin").open("rb") as file:
                return int.from_bytes(file.read(8), "little")
        with (folder / "images.txt").open("rb") as file:
            return sum(not line.startswith(b"#") for line in file) // 2  # two lines an image
    except OSError:
        return 0


def _chosen_model(root: Path, chosen: str) -> Path:
    name = chosen.replace("\\", "/").strip("/").removeprefix("./")
    file = transforms_file(root)
    if file is not None and name == file.name:
        return file
    models = [model for place in MODEL_FOLDERS for model in _models_in(root, place)]
    for model in models:
        if name in (model.relative_to(root).as_posix(), model.name):
            if missing := _missing_files(model):
                raise DatasetError(
                    f"{model} lacks {' and '.join(missing)}; copy the whole COLMAP model there."
                )
            return model
    present = [model.relative_to(root).as_posix() for model in models]
    present += [] if file is None else [file.name]
    there = (
        f"there {'is' if len(present) == 1 else 'are'} {name_list(present, _MAX_NAMES)}"
        if present
        else "there is none"
    )
    raise DatasetError(f"{root} holds no model {chosen}; {there}.")


def _models_in(root: Path, name: str) -> list[Path]:
    """Return the models in one of :data:`MODEL_FOLDERS`, or parts of some, numbered ones first.

    In the folder of the scene itself only whole ones count, as programs export them.
    """
    folder = root / name
    if not name:
        return [] if _missing_files(folder) else [folder]
    if not folder.is_dir():
        return []
    numbered = sorted((path for path in folder.iterdir() if path.name.isdecimal()), key=lambda p: int(p.name))
    return [path for path in (*numbered, folder) if _holds_model_files(path)]


def _models_elsewhere(root: Path) -> list[str]:
    """Return the places below a folder where poses lie that are not those of a scene in it."""
    if not root.is_dir():
        return []
    patterns = ("images.bin", "images.txt", "transforms.json", "transforms_train.json")
    found = [
        path
        for depth in range(_SEARCH_DEPTH)
        for pattern in patterns
        for path in root.glob("*/" * depth + pattern)
    ]
    return sorted({path.relative_to(root).as_posix() for path in found})


def _holds_model_files(folder: Path) -> bool:
    files = (folder / f"{part}{suffix}" for part in MODEL_FILES for suffix in (".bin", ".txt"))
    return any(file.is_file() for file in files)


def _missing_files(folder: Path) -> list[str]:
    """Return which files a model lacks, in the form of which there are some; none where it is complete."""
    by_form = {
        suffix: [f"{part}{suffix}" for part in MODEL_FILES if not (folder / f"{part}{suffix}").is_file()]
        for suffix in (".bin", ".txt")
    }
    if not all(by_form.values()):
        return []
    return by_form[".bin"] if len(by_form[".bin"]) < len(MODEL_FILES) else by_form[".txt"]
