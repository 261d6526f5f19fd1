"""Matching of a COLMAP model with the photographs and masks on disk."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.core.local_origin import Origin, describe_origin, is_set
from octasplat.engine.core.relative_paths import normalize_name
from octasplat.engine.core.scene_layout import is_ignored_file, is_photograph, masks_beside
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.colmap_model import (
    ColmapModel,
    PosedImage,
    numbered_models,
    posed_image_count,
    read_colmap_model,
)
from octasplat.engine.dataset.image_info import ImageInfo
from octasplat.engine.dataset.image_names import match_image_names
from octasplat.engine.dataset.images import read_image_info
from octasplat.engine.dataset.masks import mask_for
from octasplat.engine.dataset.model import DatasetModel, DatasetView, Observations
from octasplat.engine.dataset.results_among import is_run_folder
from octasplat.engine.dataset.views_file import capped_size

MIN_VIEWS = 3
"""Fewer photographs than this do not make a scene."""

IMAGE_SUFFIXES = frozenset(
    {
        ".jpg",
        ".jpeg",
        ".png",
        ".tif",
        ".tiff",
        ".exr",
        ".hdr",
        ".bmp",
        ".webp",
        ".ppm",
        ".pgm",
        ".tga",
        ".jp2",
    }
    | {".jxl", ".heic", ".avif", ".dpx", ".psd"}
)


def load_dataset_model(
    root: Path,
    *,
    max_side: int | None = None,
    model_folder: Path | None = None,
    min_views: int = MIN_VIEWS,
    for_training: bool = True,
    origin_world: Origin | None = None,
) -> DatasetModel:
    """Read the model of a scene and the headers of its photographs, but no pixels.

    Args:
        root: folder with ``images/``, a COLMAP model (see :mod:`octasplat.engine.dataset.colmap_model`) and,
            if there are any, ``masks/<image name>.png``.
        max_side: cap on the longer side of the photographs, in pixels.
        model_folder: of a model that was found for the photographs, see :mod:`octasplat.engine.poses`;
            ``root`` may then be a bare folder of photographs.
        min_views: so many photographs must be posed.
        for_training: warn of what matters to training only.
        origin_world: local origin to take, that of the scene whose photographs these are; None chooses one
            where coordinates are large, see :mod:`octasplat.engine.core.local_origin`.

    Raises:
        DatasetError: something is missing, damaged or does not fit together.
        ConfigError: ``max_side`` is not positive.
    """
    if max_side is not None and max_side < 1:
        raise ConfigError(f"max_side is {max_side}; it must be at least 1 pixel.")
    if not root.is_dir():
        raise DatasetError(f"{root} is not a folder; name the folder that holds images/ and sparse/.")
    if model_folder is None and image_folder(root) == root:
        if any(path.suffix.lower() in IMAGE_SUFFIXES for path in root.iterdir()):
            raise DatasetError(
                f"{root} is a bare folder of photographs, without camera poses; have them found: octasplat "
                "reconstruct with --poses auto, or octasplat submit."
            )
        raise DatasetError(f"{root} has no folder images; put the photographs into {root / 'images'}.")
    model = read_colmap_model(root, model_folder, origin_world=origin_world)
    if len(model.images) < min_views:
        raise DatasetError(
            f"The model in {model.folder} has {len(model.images)} posed images; "
            f"at least {min_views} {'is' if min_views == 1 else 'are'} needed."
        )
    warnings = list(model.warnings)
    if for_training and is_set(model.origin_world):
        warnings.append(
            f"The coordinates of {model.folder} are large against the scene, so it is trained about a local "
            f"origin; add {describe_origin(model.origin_world)} to what files hold that have no place for it."
        )
    if for_training and len(model.points) == 0:
        warnings.append(f"The model in {model.folder} has no 3D points; the start will be random.")
    images, paths, beside = _find_images(
        image_folder(root), model, warnings, warn_unposed=model_folder is None
    )
    masks = _mask_paths(root, [image.name for image in images], beside, warnings)
    if model_folder is None:
        _warn_of_other_models(model.folder, warnings)

    views: list[DatasetView] = []
    infos: list[ImageInfo] = []
    observed_px: list[Float64[np.ndarray, "k 2"]] = []
    camera_indices: dict[Camera, int] = {}
    for image, path, mask in zip(images, paths, masks, strict=True):
        info = read_image_info(path)
        original = model.cameras[image.camera_id]
        _check_size(original, info, image, path)
        width, height = capped_size(info.width_px, info.height_px, max_side)
        camera = original.scaled_to(width, height)
        observed_px.append(image.observed_px * (width / original.width_px, height / original.height_px))
        views.append(
            DatasetView(
                name=image.name,
                image_path=path,
                mask_path=mask,
                camera_index=camera_indices.setdefault(camera, len(camera_indices)),
                rotation_cam_from_world=image.rotation_cam_from_world,
                translation_cam_from_world=image.translation_cam_from_world,
                width_px=width,
                height_px=height,
            )
        )
        infos.append(info)
    return DatasetModel(
        views=tuple(views),
        cameras=tuple(camera_indices),
        root=root,
        model_folder=model.folder,
        image_infos=tuple(infos),
        points=model.points,
        observations=Observations(
            np.repeat(np.arange(len(views)), [len(observed) for observed in observed_px]),
            np.concatenate([image.observed_point_ids for image in images]),
            np.concatenate(observed_px),
        ),
        warnings=tuple(warnings),
        origin_world=model.origin_world,
    )


def image_folder(root: Path) -> Path:
    """Return ``images/`` or ``input/`` of a scene, or the scene itself where neither holds photographs."""
    folders = [root / name for name in ("images", "input") if (root / name).is_dir()]
    elsewhere = root if not folders or _holds_photographs(root) else folders[0]
    return next((folder for folder in folders if _holds_photographs(folder)), elsewhere)


def _holds_photographs(folder: Path) -> bool:
    names = (path.relative_to(folder).as_posix() for path in folder.rglob("*"))
    return any(is_photograph(name) and not is_ignored_file(name) for name in names)


def _find_images(
    folder: Path, model: ColmapModel, warnings: list[str], *, warn_unposed: bool
) -> tuple[list[PosedImage], list[Path], dict[str, Path]]:
    """Return the images of the model with their file names, sorted, and the files and masks beside them."""
    on_disk = _files_below(folder)
    images_on_disk = [name for name, path in on_disk.items() if path.suffix.lower() in IMAGE_SUFFIXES]
    owners = masks_beside(images_on_disk)
    names = [image.name for image in model.images]
    # Nothing outside images/ is read, whatever a model from elsewhere asks for.
    found = match_image_names(
        names, on_disk.keys() - (owners.keys() - {normalize_name(name) for name in names})
    )
    missing = [name for name in names if name not in found]
    if missing:
        raise DatasetError(
            f"{len(missing)} of {len(names)} images of the model are not in {folder} "
            f"({_name_list(missing)}); put them there or run COLMAP without them."
        )
    respelt = [name for name in names if normalize_name(name) != found[name]]
    if respelt:
        warnings.append(
            f"{len(respelt)} images of the model are spelt otherwise in {folder}; "
            f"{found[respelt[0]]} is taken for {respelt[0]}, for instance."
        )
    others = {name: found[name] for name in respelt}
    images = [replace(image, name=others.get(image.name, image.name)) for image in model.images]
    images.sort(key=lambda image: image.name)
    paths = [on_disk[normalize_name(image.name)] for image in images]
    posed = set(found.values())
    unposed = sorted(set(images_on_disk) - posed - owners.keys())
    if unposed and warn_unposed:
        warnings.append(
            f"{len(unposed)} images in {folder} have no pose and are left out ({_name_list(unposed)})."
        )
    beside = {owner: on_disk[mask] for mask, owner in owners.items() if mask not in posed}
    return images, paths, beside


def _mask_paths(
    root: Path, names: list[str], beside: dict[str, Path], warnings: list[str]
) -> list[Path | None]:
    folder = root / "masks"
    if not folder.is_dir() and not beside:
        return [None] * len(names)
    on_disk = _files_below(folder)
    on_disk = {name.casefold(): path for name, path in on_disk.items()} | on_disk
    masks = [mask_for(normalize_name(name), on_disk, beside) for name in names]
    without = [name for name, mask in zip(names, masks, strict=True) if mask is None]
    if len(without) == len(names):
        warnings.append(
            f"No mask in {folder} belongs to an image; a mask is named like its image with .png added "
            f"({names[0]}.png)."
        )
    elif without:
        warnings.append(f"{len(without)} images have no mask and count whole ({_name_list(without)}).")
    return masks


def _files_below(folder: Path) -> dict[str, Path]:
    """Return files by their NFC path below ``folder``, without hidden ones and results of runs."""
    files: dict[str, Path] = {}
    for parent, folders, names in os.walk(folder, followlinks=True):
        folders[:] = sorted(
            name for name in folders if not name.startswith(".") and not is_run_folder(Path(parent) / name)
        )
        for name in sorted(names):
            if not name.startswith("."):
                path = Path(parent) / name
                # File systems differ in how they spell an umlaut; models come from other machines.
                files[normalize_name(path.relative_to(folder).as_posix())] = path
    return files


def _check_size(camera: Camera, info: ImageInfo, image: PosedImage, path: Path) -> None:
    expected_height = camera.height_px * info.width_px / camera.width_px
    expected_width = camera.width_px * info.height_px / camera.height_px
    if min(abs(expected_height - info.height_px), abs(expected_width - info.width_px)) <= 1:
        return
    turned = (
        " (its EXIF orientation asks to turn it, which COLMAP does not do)" if info.orientation >= 5 else ""
    )
    raise DatasetError(
        f"{path} is {info.width_px}x{info.height_px} but camera {image.camera_id} of the model is "
        f"{camera.width_px}x{camera.height_px}{turned}; use the photographs COLMAP was given."
    )


def _warn_of_other_models(folder: Path, warnings: list[str]) -> None:
    parent = folder.parent if folder.name.isdigit() else folder
    counts = {other: posed_image_count(other) for other in numbered_models(parent) if other != folder}
    if counts:
        others = [f"{other.name} of {count}" for other, count in counts.items()]
        warnings.append(
            f"{parent} holds further models ({len(others)}): {_name_list(others)} images; only {folder} of "
            f"{posed_image_count(folder)} images is used; take it away to use another."
        )


def _name_list(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
