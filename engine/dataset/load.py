"""Matching of a COLMAP model with the photographs and masks on disk."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.core.local_origin import Origin, describe_origin, is_set
from octasplat.engine.core.name_lists import name_list
from octasplat.engine.core.relative_paths import normalize_name
from octasplat.engine.core.scene_layout import (
    DEPTH_FOLDERS,
    MIN_PHOTOGRAPHS,
    is_photograph,
    left_out_sentences,
    masks_beside,
)
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.colmap_model import ColmapModel, PosedImage, read_colmap_model
from octasplat.engine.dataset.colmap_reading import load_model
from octasplat.engine.dataset.damaged_images import find_damaged, read_headers, refuse_damaged
from octasplat.engine.dataset.depth_maps import find_depth_maps
from octasplat.engine.dataset.image_info import ImageInfo
from octasplat.engine.dataset.image_names import match_image_names
from octasplat.engine.dataset.masks import mask_for
from octasplat.engine.dataset.model import DatasetModel, DatasetView, Observations
from octasplat.engine.dataset.model_sources import (
    find_model,
    has_model,
    is_changed_model,
    other_models,
    posed_image_count,
)
from octasplat.engine.dataset.photograph_files import (
    files_below,
    image_folder,
    no_folder_sentence,
    photographs_below,
)
from octasplat.engine.dataset.views_file import capped_size


def load_dataset_model(
    root: Path,
    *,
    max_side: int | None = None,
    model_folder: Path | None = None,
    model: str | None = None,
    min_views: int = MIN_PHOTOGRAPHS,
    for_training: bool = True,
    origin_world: Origin | None = None,
    infos: Mapping[Path, ImageInfo] | None = None,
) -> DatasetModel:
    """Read the model of a scene and the headers of its photographs, but no pixels.

    Args:
        root: folder with ``images/``, a COLMAP model or transforms file (see
            :mod:`octasplat.engine.dataset.model_sources`) and, if there are any, ``masks/<image name>.png``.
        max_side: cap on the longer side of the photographs, in pixels.
        model_folder: of a model that was found for the photographs, see :mod:`octasplat.engine.poses`;
            ``root`` may then be a bare folder of photographs.
        model: which of several models in ``root`` to take, by its path below it or its number.
        min_views: so many photographs must be posed.
        for_training: warn of what matters to training only.
        origin_world: local origin to take, that of the scene whose photographs these are; None chooses one
            where coordinates are large, see :mod:`octasplat.engine.core.local_origin`.
        infos: headers that are known, by the files, which are then not read.

    Raises:
        DatasetError: something is missing, damaged or does not fit together.
        ConfigError: ``max_side`` is not positive.
    """
    if max_side is not None and max_side < 1:
        raise ConfigError(f"max_side is {max_side}; it must be at least 1 pixel.")
    _check_root(root, has_found_model=model_folder is not None)
    source = model_folder or find_model(root, model)
    sizes_px = {
        path.relative_to(image_folder(root)).as_posix(): (info.width_px, info.height_px)
        for path, info in (infos or {}).items()
    }
    found = read_colmap_model(source, origin_world=origin_world, sizes_px=sizes_px or None)
    if model_folder is not None and is_changed_model(model_folder) and has_model(root):
        found = _with_facts_of_given(found, find_model(root, model), sizes_px or None)
    if len(found.images) < min_views:
        raise DatasetError(
            f"The model in {found.folder} has {len(found.images)} posed images; "
            f"at least {min_views} {'is' if min_views == 1 else 'are'} needed."
        )
    warnings = list(found.warnings)
    if for_training and is_set(found.origin_world):
        warnings.append(
            f"The coordinates of {found.folder} are large against the scene, so it is trained about a local "
            f"origin; add {describe_origin(found.origin_world)} to what files hold that have no place for it."
        )
    if for_training and len(found.points) == 0:
        warnings.append(f"The model in {found.folder} has no 3D points; the start will be random.")
    located = _find_images(image_folder(root), found, warnings, warn_unposed=model_folder is None)
    masks = _mask_paths(root, located, warnings)
    depths = _depth_paths(root, located, found.depths, warnings)
    if model_folder is None:
        _warn_of_other_models(root, found.folder, warnings)

    return _model_of_views(root, found, located, masks, depths, max_side, warnings, infos or {})


def _with_facts_of_given(
    found: ColmapModel, given: Path, sizes_px: Mapping[str, tuple[int, int]] | None
) -> ColmapModel:
    """Return a model that was made of a given one with what a transforms file says beside the poses.

    Its images have the names of the given one. Models of COLMAP say nothing else.
    """
    if not given.is_file():
        return found
    said = load_model(given, sizes_px)
    return replace(found, held_out=said.held_out, masks=said.masks, depths=said.depths)


def require_masks(model: DatasetModel) -> None:
    """Refuse a scene without masks, where these are to be the alpha.

    Raises:
        DatasetError: no photograph has one.
    """
    if all(view.mask_path is None for view in model.views):
        raise DatasetError(
            f"Masks are to be the alpha, but {model.root / 'masks'} holds none of any photograph; put them "
            f"there (as {model.views[0].name}.png) or leave --masks alpha out."
        )


def _check_root(root: Path, *, has_found_model: bool) -> None:
    """Refuse a folder without photographs, or without poses unless a model was found for it."""
    if not root.is_dir():
        raise DatasetError(no_folder_sentence(root))
    if (
        not has_found_model
        and image_folder(root) == root
        and not (photographs_below(root) and has_model(root))
    ):
        if any(is_photograph(path.name) for path in root.iterdir()):
            raise DatasetError(
                f"{root} is a bare folder of photographs, without camera poses; have them found: octasplat "
                "reconstruct with --poses auto, or octasplat submit."
            )
        raise DatasetError(f"{root} has no folder images; put the photographs into {root / 'images'}.")


@dataclass(frozen=True, eq=False)
class _LocatedImages:
    """The images of a model under the names of their files.

    Attributes:
        images: sorted by name.
        paths: their files.
        masks: paths of masks beside them or named by the model, by the names of their images.
        respelt: names of files by those of the model where they differ.
    """

    images: list[PosedImage]
    paths: list[Path]
    masks: dict[str, Path]
    respelt: dict[str, str]

    def file_name(self, name: str) -> str:
        """Return the name of the file that an image of the model is taken for."""
        return self.respelt.get(name, name)


def _find_images(
    folder: Path, model: ColmapModel, warnings: list[str], *, warn_unposed: bool
) -> _LocatedImages:
    on_disk = photographs_below(folder)
    owners = masks_beside(on_disk)
    names = [image.name for image in model.images]
    # Nothing outside images/ is read, whatever a model from elsewhere asks for.
    found = match_image_names(
        names, on_disk.keys() - (owners.keys() - {normalize_name(name) for name in names})
    )
    missing = [name for name in names if name not in found]
    if missing:
        without_them = "take them out of that file" if model.folder.is_file() else "run COLMAP without them"
        unread = sorted(match_image_names(missing, files_below(folder).keys() - on_disk.keys()).values())
        raise DatasetError(
            f"{len(missing)} of {len(names)} images of the model are not in {folder} "
            f"({name_list(missing)}); "
            + (" ".join(left_out_sentences(unread)) or f"put them there or {without_them}.")
        )
    respelt = {name: found[name] for name in names if normalize_name(name) != found[name]}
    # Transforms files leave out suffixes, which is no other spelling.
    odd = [name for name in respelt if not respelt[name].startswith(f"{normalize_name(name)}.")]
    if odd:
        warnings.append(
            f"{len(odd)} images of the model are spelt otherwise in {folder}; "
            f"{found[odd[0]]} is taken for {odd[0]}, for instance."
        )
    images = [replace(image, name=respelt.get(image.name, image.name)) for image in model.images]
    # Names of files may sort otherwise than those of the model.
    images.sort(key=lambda image: image.name)
    paths = [on_disk[normalize_name(image.name)] for image in images]
    posed = set(found.values())
    unposed = sorted(set(on_disk) - posed - owners.keys())
    if unposed and warn_unposed:
        warnings.append(
            f"{len(unposed)} images in {folder} have no pose and are left out ({name_list(unposed)})."
        )
    # A file that the model has a pose for is a photograph, whatever its name ends with.
    beside = {owner: on_disk[mask] for mask, owner in owners.items() if mask not in posed}
    named = {
        respelt.get(name, name): path for name, path in _named_masks(folder, model.masks, warnings).items()
    }
    return _LocatedImages(images, paths, beside | named, respelt)


def _named_masks(folder: Path, masks: Mapping[str, str], warnings: list[str]) -> dict[str, Path]:
    """Return the masks that a transforms file names, of those in ``masks`` and beside photographs."""
    if not masks:
        return {}
    root = folder.parent if folder.name in ("images", "input") else folder
    on_disk = {f"masks/{name}": path for name, path in files_below(root / "masks").items()}
    on_disk |= {f"{folder.name}/{name}": path for name, path in files_below(folder).items()}
    paths = {
        name: PurePosixPath(normalize_name(path).replace("\\", "/")).as_posix()
        for name, path in masks.items()
    }
    there = {name: on_disk[path] for name, path in paths.items() if path in on_disk}
    gone = [masks[name] for name in masks if name not in there]
    if gone:
        warnings.append(
            f"{len(gone)} masks that the transforms file names are neither in masks/ nor beside the "
            f"photographs ({name_list(gone)}); put them into masks/."
        )
    return there


def _mask_paths(root: Path, located: _LocatedImages, warnings: list[str]) -> list[Path | None]:
    folder, names = root / "masks", [image.name for image in located.images]
    if not folder.is_dir() and not located.masks:
        return [None] * len(names)
    on_disk = files_below(folder)
    # Exact names win over those that differ in case.
    on_disk = {name.casefold(): path for name, path in on_disk.items()} | on_disk
    masks = [mask_for(normalize_name(name), on_disk, located.masks) for name in names]
    without = [name for name, mask in zip(names, masks, strict=True) if mask is None]
    if len(without) == len(names):
        warnings.append(
            f"No mask in {folder} belongs to an image; a mask is named like its image with .png added "
            f"({names[0]}.png)."
        )
    elif without:
        warnings.append(f"{len(without)} images have no mask and count whole ({name_list(without)}).")
    return masks


def _depth_paths(
    root: Path, located: _LocatedImages, named: Mapping[str, str], warnings: list[str]
) -> Sequence[Path | None]:
    names = [image.name for image in located.images]
    folder = next((root / each for each in DEPTH_FOLDERS if (root / each).is_dir()), None)
    if folder is None:
        if named:
            warnings.append(
                f"{len(named)} depth maps that the transforms file names are not used; put them into "
                f"{root / DEPTH_FOLDERS[0]}."
            )
        return [None] * len(names)
    by_file = {located.file_name(name): path for name, path in named.items()}
    found = find_depth_maps(names, files_below(folder), by_file)
    without = [name for name, path in zip(names, found, strict=True) if path is None]
    if len(without) == len(names):
        warnings.append(
            f"No depth map in {folder} belongs to a photograph; one is named like its photograph "
            f"({PurePosixPath(names[0]).stem}.png)."
        )
    elif without:
        warnings.append(f"{len(without)} photographs have no depth map ({name_list(without)}).")
    return found


def _check_size(camera: Camera, info: ImageInfo, image: PosedImage, path: Path) -> None:
    # Photographs may be resized: their ratio of sides must be the camera's, up to the rounding of one side.
    expected_height = camera.height_px * info.width_px / camera.width_px
    expected_width = camera.width_px * info.height_px / camera.height_px
    if min(abs(expected_height - info.height_px), abs(expected_width - info.width_px)) <= 1:
        return
    # EXIF orientations from 5 on swap width and height.
    turned = (
        " (its EXIF orientation asks to turn it, which COLMAP does not do)" if info.orientation >= 5 else ""
    )
    raise DatasetError(
        f"{path} is {info.width_px}x{info.height_px} but camera {image.camera_id} of the model is "
        f"{camera.width_px}x{camera.height_px}{turned}; use the photographs COLMAP was given."
    )


def _warn_of_other_models(root: Path, taken: Path, warnings: list[str]) -> None:
    others = other_models(root, taken)
    if others:
        described = [name if count is None else f"{name} of {count} images" for name, count in others.items()]
        size = f" of {posed_image_count(taken)} images" * taken.is_dir()
        warnings.append(
            f"{root} holds further models ({len(others)}): {name_list(described)}; only "
            f"{taken}{size} is used; --model {next(iter(others))} takes another."
        )


def _checked_headers(
    root: Path, paths: Sequence[Path], known: Mapping[Path, ImageInfo]
) -> Mapping[Path, ImageInfo]:
    """Return the headers of photographs by their files.

    Raises:
        DatasetError: some cannot be read; those that end early behind a header that is fine are named, too.
    """
    found, faults = read_headers(paths, known)
    if faults:
        refuse_damaged(
            sorted([*faults, *find_damaged(list(found.items()))], key=lambda fault: fault.path), root
        )
    return found


def _model_of_views(
    root: Path,
    found: ColmapModel,
    located: _LocatedImages,
    masks: Sequence[Path | None],
    depths: Sequence[Path | None],
    max_side: int | None,
    warnings: list[str],
    infos_known: Mapping[Path, ImageInfo],
) -> DatasetModel:
    """Return the model of the photographs that were found, of the sizes that ``max_side`` caps."""
    images = located.images
    views: list[DatasetView] = []
    infos: list[ImageInfo] = []
    observed_px: list[Float64[np.ndarray, "k 2"]] = []
    camera_indices: dict[Camera, int] = {}
    headers = _checked_headers(root, located.paths, infos_known)
    for image, path, mask, depth in zip(images, located.paths, masks, depths, strict=True):
        info = headers[path]
        original = found.cameras[image.camera_id]
        _check_size(original, info, image, path)
        width, height = capped_size(info.width_px, info.height_px, max_side)
        camera = original.scaled_to(width, height)
        observed_px.append(image.observed_px * (width / original.width_px, height / original.height_px))
        views.append(
            DatasetView(
                name=image.name,
                image_path=path,
                mask_path=mask,
                depth_path=depth,
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
        model_folder=found.folder,
        image_infos=tuple(infos),
        points=found.points,
        observations=Observations(
            np.repeat(np.arange(len(views)), [len(observed) for observed in observed_px]),
            np.concatenate([image.observed_point_ids for image in images]),
            np.concatenate(observed_px),
        ),
        warnings=tuple(warnings),
        origin_world=found.origin_world,
        held_out=None if found.held_out is None else tuple(map(located.file_name, found.held_out)),
    )
