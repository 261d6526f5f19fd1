"""Photographs that a scene has twice: the same file under two names, or one picture saved or taken again.

A held-out photograph whose duplicate is trained on measures memory, not the scene. Duplicates are files of
equal content in poses that a search may give one picture, and photographs of nearly one pose whose small
versions hardly differ. Only files of one length are hashed and only photographs of nearly one pose are looked
at, so that a scene without duplicates costs little.
"""

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.errors import DamagedImageError, DatasetError
from octasplat.engine.dataset.image_info import Storage
from octasplat.engine.dataset.images import ValueScale, read_photo
from octasplat.engine.dataset.model import DatasetModel, scene_extent
from octasplat.engine.dataset.value_scale import find_value_scales

NEAR_SHIFT, NEAR_TURN_RAD = 2e-3, 5e-3
"""Pictures that hardly differ are duplicates if they stand no farther apart than this share of the scene's
extent, and are turned by no more than this."""
EQUAL_SHIFT, EQUAL_TURN_RAD = 0.025, 0.1
"""The same for equal files, which a search for poses may have placed apart; views of a rendered scene that
show nothing of it are equal, too, but lie farther apart."""
NEAR_DIFFERENCE = 3.0
"""Small versions of duplicates differ by no more than this, of 255, as the root of the mean square."""
_SMALL_SIDE_PX = 32
_MAX_NAMES = 3

Group = tuple[int, ...]


@dataclass(frozen=True)
class Duplicates:
    """Views that show one picture.

    Attributes:
        groups: indices of the views of each picture that is there more than once, ascending.
        equal_files: how many of the groups hold files of equal content only.
    """

    groups: tuple[Group, ...]
    equal_files: int

    def sentence(self, names: Sequence[str]) -> str | None:
        """Return what to say of them, or None where there are none.

        Args:
            names: of all views.
        """
        if not self.groups:
            return None
        shown = ", ".join(" = ".join(names[index] for index in group) for group in self.groups[:_MAX_NAMES])
        more = ", ..." if len(self.groups) > _MAX_NAMES else ""
        near = len(self.groups) - self.equal_files
        kinds = [f"{self.equal_files} as equal files"] * bool(self.equal_files)
        kinds += [f"{near} as nearly equal ones"] * bool(near)
        return (
            f"{len(self.groups)} photographs are there more than once, {' and '.join(kinds)} ({shown}"
            f"{more}); those of a group count as one where photographs are held out, and fall on one side of "
            "the split."
        )


def find_duplicates(model: DatasetModel) -> Duplicates:
    """Return the views of a scene that show one picture.

    Raises:
        DatasetError: a file that may be a duplicate cannot be opened.
    """
    poses = _Poses(model)
    alike = _equal_files([view.image_path for view in model.views])
    pairs = [pair for group in alike for pair in itertools.combinations(group, 2)]
    equal = poses.near_pairs(np.array(pairs, np.int64).reshape(-1, 2), EQUAL_SHIFT, EQUAL_TURN_RAD)
    try:
        near = _near_pictures(model, poses, set(equal))
    except DamagedImageError:
        near = []  # all that are damaged are named when they are decoded
    groups = _merge_overlapping_groups(len(model.views), (*equal, *near))
    return Duplicates(groups, len(set(groups) & set(_merge_overlapping_groups(len(model.views), equal))))


def _equal_files(paths: Sequence[Path]) -> list[Group]:
    by_size: dict[int, list[int]] = {}
    for index, path in enumerate(paths):
        by_size.setdefault(path.stat().st_size, []).append(index)
    by_content: dict[bytes, list[int]] = {}
    for indices in by_size.values():
        if len(indices) > 1:
            for index in indices:
                by_content.setdefault(_file_digest(paths[index]), []).append(index)
    return [tuple(indices) for indices in by_content.values() if len(indices) > 1]


def _file_digest(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").digest()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read ({error.strerror}); replace the file.") from error


class _Poses:
    """Where photographs were taken, to be compared."""

    def __init__(self, model: DatasetModel) -> None:
        self.centres = np.stack([view.origin_world for view in model.views])
        self.rotations = np.stack([view.rotation_cam_from_world for view in model.views])
        self.extent = scene_extent(self.centres, model.points)

    def near_pairs(self, pairs: Int64[np.ndarray, "p 2"], shift: float, turn_rad: float) -> list[Group]:
        """Return the pairs that are no farther apart than a share of the extent and an angle."""
        one, two = pairs.T
        apart = np.linalg.norm(self.centres[one] - self.centres[two], axis=1)
        # The chord between two rotation matrices is sqrt(8) sin(angle / 2).
        chords = np.linalg.norm(self.rotations[one] - self.rotations[two], axis=(1, 2))
        is_near = (apart <= shift * self.extent) & (chords <= np.sqrt(8) * np.sin(turn_rad / 2))
        return [(a, b) for a, b in pairs[is_near].tolist()]


def _near_pictures(model: DatasetModel, poses: _Poses, known: set[Group]) -> list[Group]:
    """Return pairs of views of nearly one pose and nearly one picture, without those known already."""
    from scipy.spatial import cKDTree  # here, as most who import this module compare nothing

    close = cKDTree(poses.centres).query_pairs(NEAR_SHIFT * poses.extent, output_type="ndarray")
    near = poses.near_pairs(close.astype(np.int64), NEAR_SHIFT, NEAR_TURN_RAD)
    pairs = [pair for pair in near if pair not in known]
    indices = sorted({index for pair in pairs for index in pair})
    scales = _value_scales(model, indices)
    small = {
        index: _small_picture(model, index, scales.get(model.image_infos[index].storage)) for index in indices
    }
    return [(a, b) for a, b in pairs if _rms_difference(small[a], small[b]) <= NEAR_DIFFERENCE]


def _value_scales(model: DatasetModel, indices: Sequence[int]) -> dict[Storage, ValueScale]:
    """Return the scales that the photographs of ``indices`` are trained with."""
    photographs = [(view.image_path, info) for view, info in zip(model.views, model.image_infos, strict=True)]
    # All photographs of a storage share a scale; they are read only if those compared seem to have one.
    scaled, _ = find_value_scales([photographs[index] for index in indices])
    return find_value_scales([each for each in photographs if each[1].storage in scaled])[0]


def _small_picture(model: DatasetModel, index: int, scale: ValueScale | None) -> Float32[np.ndarray, "h w 3"]:
    info = model.image_infos[index]
    width, height = min(_SMALL_SIDE_PX, info.width_px), min(_SMALL_SIDE_PX, info.height_px)
    return read_photo(model.views[index].image_path, width, height, 8, scale)[0].astype(np.float32)


def _rms_difference(one: Float32[np.ndarray, "h w 3"], two: Float32[np.ndarray, "h w 3"]) -> float:
    return float(np.sqrt(np.mean((one - two) ** 2))) if one.shape == two.shape else np.inf


def _merge_overlapping_groups(count: int, groups: Sequence[Group]) -> tuple[Group, ...]:
    """Return the groups with those that share a view made one, of two views or more."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    # Each group links its first view with all of its views; connected groups become one.
    rows = [group[0] for group in groups for _ in group]
    columns = [index for group in groups for index in group]
    links = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    _, labels = connected_components(links, directed=False)
    by_label: dict[int, list[int]] = {}
    for index, label in enumerate(labels.tolist()):
        by_label.setdefault(label, []).append(index)
    return tuple(tuple(indices) for indices in by_label.values() if len(indices) > 1)
