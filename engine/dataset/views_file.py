"""``views.json``: the photographs, cameras and split of a run.

A later command can tell other photographs from these, and needs no photographs where cameras suffice. For
every photograph it has the name, size, pose and camera, whether it was held out, and digests of its file and
of its mask's; for the sparse points one digest. The folder of the photographs is not part of it.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Int64
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    model_serializer,
    model_validator,
)

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin, is_set
from octasplat.engine.core.relative_paths import check_relative_path
from octasplat.engine.core.writing import write_text
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.model import DatasetModel, PosedView, SparsePoints, Viewpoints, scene_extent
from octasplat.engine.dataset.scene_split import SplitRule, split_scene
from octasplat.engine.dataset.training_points import training_points

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Row = tuple[_Finite, _Finite, _Finite]
_Pixels = Annotated[int, Field(ge=1)]
_MAX_NAMES = 3
_POSE_TOLERANCE = 1e-5
"""Poses this much apart, as a share of the scene's extent, are one: programs write so many digits."""
_ADJUSTED = 0.1
"""Poses within this share of the extent and this angle in radians may have been adjusted in one world."""


@dataclass(frozen=True)
class FileDigests:
    """SHA-256 of a photograph's file, and of its mask's if it has one; hexadecimal."""

    photograph: str
    mask: str | None


@dataclass(frozen=True, eq=False)
class SplitViewpoints(Viewpoints):
    """Viewpoints of a run.

    Attributes:
        train_indices: views trained on.
        test_indices: views held out.
        extent: radius of the training cameras in world units, see
            :func:`octasplat.engine.dataset.model.scene_extent`.
    """

    train_indices: Int64[np.ndarray, " train"]
    test_indices: Int64[np.ndarray, " test"]
    extent: float


class _FrozenModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class _CameraEntry(_FrozenModel):
    model: str
    params: tuple[_Finite, ...]
    width_px: _Pixels
    height_px: _Pixels


class _ViewEntry(_FrozenModel):
    name: Annotated[str, AfterValidator(check_relative_path)]
    camera: Annotated[int, Field(ge=0)]
    rotation_cam_from_world: tuple[_Row, _Row, _Row]
    translation_cam_from_world: _Row
    width_px: _Pixels
    height_px: _Pixels
    photograph_width_px: _Pixels
    photograph_height_px: _Pixels
    photograph_sha256: str
    mask_sha256: str | None
    held_out: bool


class ViewsRecord(_FrozenModel):
    """The content of ``views.json``; two are equal where photographs, masks, model and split are."""

    format: Literal[1] = 1
    extent_world: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    points_sha256: str
    cameras: tuple[_CameraEntry, ...]
    views: Annotated[tuple[_ViewEntry, ...], Field(min_length=1)]
    origin_world: _Row = NO_ORIGIN
    depths_sha256: str | None = None

    @model_serializer(mode="wrap")
    def _without_defaults(self, write: Callable[["ViewsRecord"], dict[str, object]]) -> dict[str, object]:
        content = write(self)
        # Left out where there is none, so that fingerprints are those of records that do not know of it
        if not is_set(self.origin_world):
            del content["origin_world"]
        if self.depths_sha256 is None:
            del content["depths_sha256"]
        return content

    @model_validator(mode="after")
    def _cameras_exist(self) -> "ViewsRecord":
        if any(view.camera >= len(self.cameras) for view in self.views):
            raise ValueError("a view names a camera that is not there")
        return self

    def fingerprint(self) -> str:
        """Return the SHA-256 of the record's JSON."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()

    def viewpoints(self, max_side: int | None) -> SplitViewpoints:
        """Return the viewpoints for photographs capped to ``max_side`` (px); None keeps their size."""
        cameras: dict[Camera, int] = {}
        views = []
        for row in self.views:
            at = self.cameras[row.camera]
            width, height = capped_size(row.photograph_width_px, row.photograph_height_px, max_side)
            camera = Camera(at.model, at.params, at.width_px, at.height_px).scaled_to(width, height)
            views.append(
                PosedView(
                    name=row.name,
                    camera_index=cameras.setdefault(camera, len(cameras)),
                    rotation_cam_from_world=np.array(row.rotation_cam_from_world),
                    translation_cam_from_world=np.array(row.translation_cam_from_world),
                    width_px=width,
                    height_px=height,
                )
            )
        held_out = np.array([row.held_out for row in self.views])
        return SplitViewpoints(
            views=tuple(views),
            cameras=tuple(cameras),
            train_indices=np.flatnonzero(~held_out).astype(np.int64),
            test_indices=np.flatnonzero(held_out).astype(np.int64),
            extent=self.extent_world,
        )

    def about(self, origin_world: Origin) -> "ViewsRecord":
        """Return the views with poses relative to another local origin."""
        if origin_world == self.origin_world:
            return self
        # x_new = x_old + old origin - new origin
        shift = np.array(self.origin_world) - np.array(origin_world)
        moved = self.transformed(1.0, np.eye(3), shift)
        return moved.model_copy(update={"origin_world": origin_world})

    def transformed(
        self, scale: float, turn: Float[np.ndarray, "3 3"], shift_world: Float[np.ndarray, "3"]
    ) -> "ViewsRecord":
        """Return the views in a world that was rotated, scaled and then shifted; the images stay the same."""
        views = []
        for row in self.views:
            # x' = scale turn x + shift, so that R' = R turn^T and t' = scale t - R' shift
            rotation = np.array(row.rotation_cam_from_world) @ turn.T
            translation = scale * np.array(row.translation_cam_from_world) - rotation @ shift_world
            pose = {
                "rotation_cam_from_world": tuple(map(tuple, rotation.tolist())),
                "translation_cam_from_world": tuple(translation.tolist()),
            }
            views.append(row.model_copy(update=pose))
        return self.model_copy(update={"extent_world": scale * self.extent_world, "views": tuple(views)})

    def difference(self, other: "ViewsRecord") -> str | None:
        """Describe in a few words how ``other`` differs; None if it does not."""
        mine, others = {view.name: view for view in self.views}, {view.name: view for view in other.views}
        if mine.keys() != others.keys():
            missing, added = sorted(mine.keys() - others.keys()), sorted(others.keys() - mine.keys())
            changes = [f"{_name_list(missing)} missing"] * bool(missing) + [
                f"{_name_list(added)} added"
            ] * bool(added)
            return " and ".join(changes)
        pairs = [
            (name, self._compared_values(view), other._compared_values(others[name]))
            for name, view in mine.items()
        ]
        for what in pairs[0][1]:
            names = [name for name, here, there in pairs if here[what] != there[what]]
            if names:
                return f"{_name_list(names)} with another {what}"
        if self.points_sha256 != other.points_sha256:
            return "other sparse points"
        if self.depths_sha256 != other.depths_sha256:
            return "other depth maps or another known geometry"
        return None if self == other else "another split"

    def is_of_same_world(self, other: "ViewsRecord") -> bool:
        """Return whether ``other`` has photographs of the same names in the same poses."""
        others = {view.name: view for view in other.about(self.origin_world).views}
        shared = [(view, others[view.name]) for view in self.views if view.name in others]
        return bool(shared) and all(
            np.allclose(one.rotation_cam_from_world, two.rotation_cam_from_world, atol=_POSE_TOLERANCE)
            and np.allclose(
                one.translation_cam_from_world,
                two.translation_cam_from_world,
                rtol=_POSE_TOLERANCE,
                atol=_POSE_TOLERANCE * self.extent_world,
            )
            for one, two in shared
        )

    def is_of_another_world(self, other: "ViewsRecord") -> bool:
        """Return whether most of the photographs that ``other`` shares have other poses there.

        Single ones may differ, as those that a run corrected; and all may differ a little, as where it
        adjusted lenses.
        """
        others = {(view.name, view.photograph_sha256): view for view in other.about(self.origin_world).views}
        names = ((view, (view.name, view.photograph_sha256)) for view in self.views)
        shared = [(view, others[name]) for view, name in names if name in others]
        return 2 * sum(self._stands_elsewhere(one, two) for one, two in shared) > len(shared)

    def has_other_poses(self, views: Sequence[PosedView]) -> bool:
        """Return whether most of the views of the same names, about the same origin, have other poses."""
        mine = {view.name: view for view in self.views}
        shared = [(mine[view.name], view) for view in views if view.name in mine]
        return 2 * sum(self._stands_elsewhere(one, two) for one, two in shared) > len(shared)

    def _stands_elsewhere(self, one: _ViewEntry, two: _ViewEntry | PosedView) -> bool:
        turns = [np.array(view.rotation_cam_from_world) for view in (one, two)]
        shifts = [np.array(view.translation_cam_from_world) for view in (one, two)]
        first, second = (-turn.T @ shift for turn, shift in zip(turns, shifts, strict=True))
        apart = float(np.linalg.norm(first - second))
        return apart > _ADJUSTED * self.extent_world or float(np.abs(turns[0] - turns[1]).max()) > _ADJUSTED

    def _compared_values(self, view: _ViewEntry) -> dict[str, object]:
        """Return the values of a view that :meth:`difference` compares, by name."""
        return {
            "file": view.photograph_sha256,
            "mask": view.mask_sha256,
            "pose": (view.rotation_cam_from_world, view.translation_cam_from_world),
            "camera": self.cameras[view.camera],
        }


def views_record(
    model: DatasetModel,
    digests: Sequence[FileDigests],
    test_indices: Int64[np.ndarray, " test"],
    depths_sha256: str | None = None,
) -> ViewsRecord:
    """Return the record of a dataset and its split.

    Args:
        model: the scene.
        digests: of the files of its views, in their order.
        test_indices: views that are held out; where all are, they give the extent.
        depths_sha256: digest of the depth maps and the known geometry, where there are any.
    """
    held_out = set(test_indices.tolist())
    train = [index for index in range(len(model.views)) if index not in held_out] or sorted(held_out)
    return ViewsRecord(
        origin_world=model.origin_world,
        extent_world=_training_extent(model, np.array(train)),
        points_sha256=_points_digest(model.points),
        depths_sha256=depths_sha256,
        cameras=tuple(
            _CameraEntry(model=c.model, params=c.params, width_px=c.width_px, height_px=c.height_px)
            for c in model.cameras
        ),
        views=tuple(
            _ViewEntry(
                name=view.name,
                camera=view.camera_index,
                rotation_cam_from_world=view.rotation_cam_from_world.tolist(),
                translation_cam_from_world=view.translation_cam_from_world.tolist(),
                width_px=view.width_px,
                height_px=view.height_px,
                photograph_width_px=info.width_px,
                photograph_height_px=info.height_px,
                photograph_sha256=files.photograph,
                mask_sha256=files.mask,
                held_out=index in held_out,
            )
            for index, (view, info, files) in enumerate(
                zip(model.views, model.image_infos, digests, strict=True)
            )
        ),
    )


def scene_viewpoints(model: DatasetModel, rule: SplitRule) -> SplitViewpoints:
    """Return the viewpoints of a loaded dataset, split as by :func:`split_scene`."""
    split = split_scene(model, rule)
    train, test = split.train_indices, split.test_indices
    return SplitViewpoints(model.views, model.cameras, train, test, _training_extent(model, train))


def write_views(path: Path, record: ViewsRecord) -> None:
    """Write the record to ``path`` (``views.json``) atomically."""
    write_text(path, record.model_dump_json(indent=1) + "\n")


def read_views(path: Path) -> ViewsRecord:
    """Read ``views.json``.

    Raises:
        ConfigError: the file is missing, damaged, or of another version.
    """
    try:
        return ViewsRecord.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        fault = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error.strerror
        raise ConfigError(f"{path} cannot be read ({fault}); delete it to do without.") from None


def capped_size(width_px: int, height_px: int, max_side: int | None) -> tuple[int, int]:
    """Return width and height after the cap on the longer side; never enlarged, never below one pixel.

    >>> capped_size(4032, 3024, 1600), capped_size(640, 480, 1600), capped_size(640, 480, None)
    ((1600, 1200), (640, 480), (640, 480))
    """
    longer = max(width_px, height_px)
    if max_side is None or longer <= max_side:
        return width_px, height_px
    ratio = max_side / longer
    return max(1, round(width_px * ratio)), max(1, round(height_px * ratio))


def _training_extent(model: DatasetModel, train_indices: Int64[np.ndarray, " train"]) -> float:
    points = training_points(train_indices, model.points, model.observations)
    return scene_extent(np.stack([model.views[i].origin_world for i in train_indices]), points)


def _points_digest(points: SparsePoints) -> str:
    digest = hashlib.sha256()
    for values in (points.xyz_world, points.rgb_srgb, points.track_lengths, points.errors_px):
        digest.update(np.ascontiguousarray(values).tobytes())
    return digest.hexdigest()


def _name_list(names: Sequence[str]) -> str:
    return ", ".join(names[:_MAX_NAMES]) + (
        f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
    )
