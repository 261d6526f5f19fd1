"""Reading the poses of a scene into a reconstruction of pycolmap, whatever program wrote the files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset.colmap_binary import (
    Observations,
    check_binary_colmap_model,
    read_binary_model,
    read_binary_observations,
)
from octasplat.engine.dataset.colmap_records import ModelRecords, build_reconstruction
from octasplat.engine.dataset.colmap_text import is_plain_text_model, read_text_model
from octasplat.engine.dataset.image_names import match_image_names
from octasplat.engine.dataset.photograph_files import image_folder, photographs_below
from octasplat.engine.dataset.transforms_file import read_transforms

MODEL_FILES = ("cameras", "images", "points3D")


@dataclass(frozen=True, eq=False)
class LoadedModel:
    """A reconstruction of pycolmap, and what its files say besides.

    Attributes:
        reconstruction: the model.
        notes: sentences on what was read otherwise than it stands there, or not at all.
        held_out: names of the images that the files hold out; None where they do not say.
        masks: paths of masks, by the names of their images.
        depths: paths of depth maps, likewise.
        observations: by the ids of images, where they were read without pycolmap, which gives one at a time.
    """

    reconstruction: Any
    notes: tuple[str, ...] = ()
    held_out: tuple[str, ...] | None = None
    masks: Mapping[str, str] = field(default_factory=dict)
    depths: Mapping[str, str] = field(default_factory=dict)
    observations: Mapping[int, Observations] | None = None


def load_model(path: Path, sizes_px: Mapping[str, tuple[int, int]] | None = None) -> LoadedModel:
    """Read a COLMAP model by its folder, or poses by their transforms file.

    COLMAP's own reader reads what it reads as meant; :mod:`octasplat.engine.dataset.colmap_text` and
    :mod:`octasplat.engine.dataset.colmap_binary` read the rest.

    Args:
        path: folder of a model, or a transforms file.
        sizes_px: width and height of photographs by their names, for transforms files that do not say them;
            None looks at the photographs beside the file.

    Raises:
        DatasetError: a file is missing or damaged; the sentence names it, and the line where there are lines.
    """
    if path.is_file():
        found = read_transforms(path, lambda names: _photograph_sizes(names, path.parent, sizes_px))
        reconstruction, _ = _build(path, found.records)
        return LoadedModel(reconstruction, found.records.repairs, found.held_out, found.masks, found.depths)
    check_binary_colmap_model(path)
    is_binary = all((path / f"{part}.bin").is_file() for part in MODEL_FILES)
    if is_binary or is_plain_text_model(path):
        try:
            observations = read_binary_observations(path / "images.bin") if is_binary else None
            return LoadedModel(pycolmap.Reconstruction(str(path)), observations=observations)
        except (ValueError, IndexError, KeyError, TypeError, RuntimeError, OSError):
            pass  # read again with care, which says where it stops
    records = read_binary_model(path) if is_binary else read_text_model(path)
    reconstruction, foreign = _build(path, records)
    notes = list(records.repairs)
    if foreign:
        notes.append(
            f"Points of the model in {path} name {foreign} observations that its images do not have, as in "
            "a part of a larger model; the points are kept, these observations are not."
        )
    return LoadedModel(reconstruction, tuple(notes))


def _build(path: Path, records: ModelRecords) -> tuple[Any, int]:
    try:
        return build_reconstruction(records)
    except (ValueError, IndexError, KeyError, TypeError, RuntimeError, OSError) as error:
        reason = " ".join(str(error).split())[:200].rstrip(".") or type(error).__name__
        raise DatasetError(
            f"The COLMAP model in {path} cannot be read ({reason}); copy it anew or run COLMAP again."
        ) from error


def _photograph_sizes(
    names: Sequence[str], root: Path, sizes_px: Mapping[str, tuple[int, int]] | None
) -> dict[str, tuple[int, int]]:
    """Return the sizes of photographs by the names that a model gives them."""
    if not names:
        return {}
    paths = photographs_below(image_folder(root)) if sizes_px is None else {}
    files = match_image_names(names, paths.keys() if sizes_px is None else sizes_px.keys())
    for name in names:
        if name not in files:
            raise DatasetError(
                f"The photograph {name} of the transforms file is not there, and the file does not say how "
                "large it is (w and h); put it there."
            )
    if sizes_px is not None:
        return {name: sizes_px[files[name]] for name in names}
    # Needs OpenImageIO, which the front end lacks; it gives the sizes.
    from octasplat.engine.dataset.images import read_image_info

    infos = {name: read_image_info(paths[files[name]]) for name in names}
    return {name: (info.width_px, info.height_px) for name, info in infos.items()}
