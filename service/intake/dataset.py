"""Validation of datasets: of single files as they arrive, and of the whole at its commit."""

import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from octasplat.engine.core.portable_names import quoted_name
from octasplat.engine.core.scene_layout import IMAGES, FileRole, file_role, masks_beside, too_few_photographs
from octasplat.service.intake.faults import IntakeError, IntakeFault
from octasplat.service.intake.image_completeness import check_complete
from octasplat.service.intake.images import ImageHeader, ImageLimits, read_image_header
from octasplat.service.intake.model_check import ModelLimits, check_model
from octasplat.service.intake.model_child import ModelAnswer
from octasplat.service.intake.upload_names import FileNames, check_scene_file
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.trees import TreeFile

_MAX_FAULTS = 100
_ROLES_WITHOUT_PIXELS = (FileRole.MODEL, FileRole.CONTROL, FileRole.GEOMETRY)
DEFAULT_IMAGE_LIMITS = ImageLimits()


@dataclass(frozen=True)
class DatasetFile:
    """A file of a dataset, as the table knows it.

    Attributes:
        path: name in the dataset, e.g. ``images/a.jpg``.
        sha256: digest of its content.
        size_bytes: length of its content.
        width_px: width of an image, None where it is not known yet.
        height_px: height of an image.
        warning: what was odd about it when it came.
    """

    path: str
    sha256: str
    size_bytes: int
    width_px: int | None = None
    height_px: int | None = None
    warning: str | None = None


@dataclass(frozen=True)
class DatasetLimits:
    """Limits of a dataset, by part."""

    image: ImageLimits = field(default_factory=ImageLimits)
    model: ModelLimits = field(default_factory=ModelLimits)
    max_photographs: int = 20_000


DEFAULT_LIMITS = DatasetLimits()


@dataclass(frozen=True)
class DatasetSummary:
    """Summary of a valid dataset.

    Attributes:
        photographs: files in ``images/``.
        pixels: pixels of all of them.
        size_bytes: length of all files.
        masks: files in ``masks/``.
        has_model: whether there is a COLMAP model; without one, poses are yet to be found.
        views: posed photographs.
        cameras: cameras in use.
        camera_models: their models, by COLMAP's names.
        points: sparse points.
        warnings: one sentence each on what is odd but usable.
    """

    photographs: int
    pixels: int
    size_bytes: int
    masks: int
    has_model: bool
    views: int = 0
    cameras: int = 0
    camera_models: tuple[str, ...] = ()
    points: int = 0
    warnings: tuple[str, ...] = ()


def check_file_content(
    storage: Storage, name: str, sha256: str, limits: ImageLimits = DEFAULT_IMAGE_LIMITS
) -> ImageHeader | None:
    """Check a stored file before it is added to a dataset; returns the header of an image, else None.

    Raises:
        IntakeError: the header is refused, or the file was cut off.
        StorageError: the content cannot be had.
    """
    if file_role(name) in _ROLES_WITHOUT_PIXELS:
        return None
    with storage.open(sha256) as file:
        header = read_image_header(file, name, limits)
        check_complete(file, name, header.kind)
        return header


def check_dataset(
    storage: Storage, files: Sequence[DatasetFile], limits: DatasetLimits = DEFAULT_LIMITS
) -> DatasetSummary:
    """Check a whole dataset, the COLMAP model in a child process; takes a second or more.

    Args:
        storage: holds the contents.
        files: all files of the dataset.
        limits: what it may ask for.

    Raises:
        IntakeError: with all faults that were found.
        StorageError: contents cannot be had.
    """
    faults: list[IntakeFault] = []
    warnings: list[str] = []
    _check_file_names(files, faults)
    # All that follows goes by the names.
    if faults:
        raise IntakeError(*faults[:_MAX_FAULTS])
    sizes = _image_sizes(storage, files, limits.image, faults, warnings)
    names = photographs_among(file.path for file in files)
    photographs = {name.removeprefix(IMAGES): sizes[name] for name in names if name in sizes}
    if (fault := photograph_count_fault(len(names), limits.max_photographs)) is not None:
        faults.append(fault)
    masks = _check_masks(files, sizes, faults, warnings)
    model = [
        TreeFile(path=file.path, sha256=file.sha256, size_bytes=file.size_bytes)
        for file in files
        if file_role(file.path) is FileRole.MODEL
    ]
    answer = ModelAnswer()
    # Last, and only where all else is sound, as it takes a process of its own.
    if model and not faults:
        answer = check_model(storage, model, photographs, limits.model)
        faults += answer.faults
        warnings += answer.warnings
    if faults:
        raise IntakeError(*faults[:_MAX_FAULTS])
    return DatasetSummary(
        photographs=len(names),
        pixels=sum(width * height for width, height in photographs.values()),
        size_bytes=sum(file.size_bytes for file in files),
        masks=masks,
        has_model=bool(model),
        views=answer.views,
        cameras=answer.cameras,
        camera_models=tuple(answer.camera_models),
        points=answer.points,
        warnings=tuple(warnings),
    )


def photographs_among(names: Iterable[str]) -> list[str]:
    """Return which files of a dataset are photographs: masks that lie beside them are none."""
    images = [name for name in names if file_role(name) is FileRole.IMAGE]
    masks = masks_beside(images)
    return [name for name in images if name not in masks]


def photograph_count_fault(count: int, limit: int) -> IntakeFault | None:
    """Return what is wrong with so many photographs; None where they can be taken."""
    if count > limit:
        return IntakeFault("dataset-photographs", f"There are {count} photographs; {limit} are allowed.")
    sentence = too_few_photographs(count)
    return None if sentence is None else IntakeFault("dataset-photographs", sentence)


def _check_file_names(files: Sequence[DatasetFile], faults: list[IntakeFault]) -> None:
    known = FileNames()
    for file in files:
        try:
            known.add(file.path)
            check_scene_file(file.path)
        except IntakeError as error:
            faults += error.faults


def _image_sizes(
    storage: Storage,
    files: Sequence[DatasetFile],
    limits: ImageLimits,
    faults: list[IntakeFault],
    warnings: list[str],
) -> dict[str, tuple[int, int]]:
    sizes: dict[str, tuple[int, int]] = {}
    for file in files:
        if file_role(file.path) in _ROLES_WITHOUT_PIXELS:
            continue
        if file.width_px is not None and file.height_px is not None:
            sizes[file.path] = file.width_px, file.height_px
            if file.warning is not None and len(warnings) < _MAX_FAULTS:
                warnings.append(file.warning)
            continue
        try:
            header = check_file_content(storage, file.path, file.sha256, limits)
        except IntakeError as error:
            faults += error.faults
            continue
        if header is not None:
            sizes[file.path] = header.width_px, header.height_px
            if header.warning is not None and len(warnings) < _MAX_FAULTS:
                warnings.append(header.warning)
    return sizes


def _check_masks(
    files: Sequence[DatasetFile],
    sizes: dict[str, tuple[int, int]],
    faults: list[IntakeFault],
    warnings: list[str],
) -> int:
    """Check masks against their photographs, whose names they have with ``.png`` at the end."""
    # File systems differ in whether they compose the characters of a name.
    photographs = {unicodedata.normalize("NFC", path): size for path, size in sizes.items()}
    masks = [file.path for file in files if file_role(file.path) is FileRole.MASK]
    alone = 0
    for path in masks:
        of_image = path.removeprefix("masks/").removesuffix(".png")
        photograph = photographs.get(unicodedata.normalize("NFC", f"images/{of_image}"))
        if photograph is None or not path.endswith(".png"):
            alone += 1
        elif path in sizes and sizes[path] != photograph:
            width, height = sizes[path]
            faults.append(
                IntakeFault(
                    "mask-size",
                    f"{quoted_name(path)} is {width}x{height} but its photograph is "
                    f"{photograph[0]}x{photograph[1]}; make the mask as large as the photograph.",
                    path,
                )
            )
    if alone:
        warnings.append(
            f"{alone} masks belong to no photograph; a mask is named like its photograph with .png added."
        )
    return len(masks) - alone + len(masks_beside(path for path in sizes if path.startswith(IMAGES)))
