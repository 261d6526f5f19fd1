"""Poses in ``transforms.json``: that of nerfstudio and instant-ngp, and those of Blender's synthetic scenes.

All give the pose of each photograph as a matrix from camera to world coordinates, where the camera looks
along -z with y up; here it looks along z with y down. World coordinates are those of the file.
"""

import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Int64
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.errors import DatasetError, SceneFileError
from octasplat.engine.core.name_lists import name_list
from octasplat.engine.core.ply_container import read_ply
from octasplat.engine.dataset.colmap_records import CameraRecord, ImageRecord, ModelRecords, PointRecord

ONE_FILE, TRAIN_FILE, TEST_FILE, VALIDATION_FILE = (
    "transforms.json", "transforms_train.json", "transforms_test.json", "transforms_val.json",
)  # fmt: skip
SizesOf = Callable[[Sequence[str]], Mapping[str, tuple[int, int]]]
"""Returns the sizes of photographs in pixels, by their names below the folder of the photographs."""

_ROTATION_TOLERANCE = 1e-3
_PINHOLES = frozenset({"PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"})
_LENSES = frozenset({"OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV"})
_FISHEYES = frozenset({"OPENCV_FISHEYE", "FISHEYE"})
_PANORAMA = "EQUIRECTANGULAR"
_NO_MATTER = frozenset(
    {"rotation", "sharpness", "colmap_im_id", "aabb_scale", "scale", "offset", "applied_transform"}
    | {"applied_scale", "orientation_override", "up", "n_extra_learnable_dims", "aabb", "from_na"}
)
"""Keys that say nothing about photographs and cameras, or what follows from the rest."""
_MAX_NAMES = 3

_Number = Annotated[float, Field(allow_inf_nan=False)]


class _Lens(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True)

    camera_model: str | None = None
    is_fisheye: bool | None = None
    w: Annotated[_Number | None, Field(ge=1)] = None
    h: Annotated[_Number | None, Field(ge=1)] = None
    fl_x: Annotated[_Number | None, Field(gt=0)] = None
    fl_y: Annotated[_Number | None, Field(gt=0)] = None
    camera_angle_x: Annotated[_Number | None, Field(gt=0, lt=math.pi)] = None
    camera_angle_y: Annotated[_Number | None, Field(gt=0, lt=math.pi)] = None
    cx: _Number | None = None
    cy: _Number | None = None
    k1: _Number | None = None
    k2: _Number | None = None
    k3: _Number | None = None
    k4: _Number | None = None
    p1: _Number | None = None
    p2: _Number | None = None


class _Frame(_Lens):
    file_path: Annotated[str, Field(min_length=1)]
    transform_matrix: Annotated[
        list[Annotated[list[_Number], Field(min_length=4, max_length=4)]], Field(min_length=3, max_length=4)
    ]
    mask_path: str | None = None
    depth_file_path: str | None = None


class _File(_Lens):
    frames: list[_Frame]
    ply_file_path: str | None = None
    train_filenames: list[str] | None = None
    test_filenames: list[str] | None = None
    val_filenames: list[str] | None = None


_LENS_KEYS = tuple(_Lens.model_fields)
_SIZE_KEYS = frozenset({"w", "h"})
_FOCAL_KEYS = frozenset({"fl_x", "fl_y", "camera_angle_x", "camera_angle_y"})


@dataclass(frozen=True)
class TransformsModel:
    """Cameras and poses of transforms files.

    Attributes:
        records: cameras, photographs, and points if a file names some.
        held_out: names of the photographs to hold out; None where the files do not say.
        masks: paths of masks as the files have them, by the names of their photographs.
        depths: those of depth maps, likewise.
    """

    records: ModelRecords
    held_out: tuple[str, ...] | None
    masks: Mapping[str, str]
    depths: Mapping[str, str]


def transforms_file(root: Path) -> Path | None:
    """Return the file of a scene with which its poses begin, or None where it has none."""
    return next((path for name in (ONE_FILE, TRAIN_FILE) if (path := root / name).is_file()), None)


def read_transforms(path: Path, sizes_of: SizesOf) -> TransformsModel:
    """Read the poses that ``path`` gives, and those of the test views beside a ``transforms_train.json``.

    Args:
        path: a ``transforms.json`` or ``transforms_train.json``.
        sizes_of: returns width and height of photographs that the files do not say them of, by their names.

    Raises:
        DatasetError: something is missing, or makes no camera or pose; the sentence names file and frame.
    """
    notes: list[str] = []
    parts = [path]
    held_out: list[str] | None = None
    if path.name == TRAIN_FILE:
        others = [path.with_name(name) for name in (TEST_FILE, VALIDATION_FILE)]
        present = [other for other in others if other.is_file()]
        parts += present[:1]
        if len(present) > 1:
            notes.append(
                f"{present[1]} is not read: its views are neither trained on nor measured, as "
                f"{present[0].name} has those to be held out."
            )
    files = [_read_file(part) for part in parts]
    if len(files) > 1:
        held_out = [photograph_name(frame.file_path) for frame in files[1].frames]
    else:
        files[0], held_out = _follow_lists(path, files[0], notes)
    cameras: dict[tuple[object, ...], CameraRecord] = {}
    images: dict[int, ImageRecord] = {}
    masks: dict[str, str] = {}
    depths: dict[str, str] = {}
    sizes_px = sizes_of(_unsized_photographs(files))
    for part, file in zip(parts, files, strict=True):
        for frame in file.frames:
            name = photograph_name(frame.file_path)
            model, width, height, params = _camera_of_frame(part, file, frame, sizes_px)
            key = (model, width, height, params)
            camera = cameras.setdefault(key, CameraRecord(len(cameras) + 1, model, width, height, params))
            number = len(images) + 1
            images[number] = _posed_image(part, frame, number, name, camera.camera_id)
            if frame.mask_path is not None:
                masks[name] = frame.mask_path
            if frame.depth_file_path is not None:
                depths[name] = frame.depth_file_path
    notes += _unread_keys(parts, files)
    points = _read_points(path, files[0].ply_file_path, notes)
    by_id = {camera.camera_id: camera for camera in cameras.values()}
    records = ModelRecords(by_id, images, points, tuple(notes))
    return TransformsModel(records, None if held_out is None else tuple(held_out), masks, depths)


def photograph_name(file_path: str) -> str:
    """Return the name of a photograph below the folder of the photographs; it may lack its suffix.

    >>> photograph_name("./train/r_0"), photograph_name("/home/me/fox/images/0001.jpg")
    ('train/r_0', '0001.jpg')
    """
    path = file_path.replace("\\", "/")
    return re.sub(r"^(\./)*((.*/)?(images|input)/)?", "", path)


def _read_file(path: Path) -> _File:
    try:
        # With or without a byte order mark
        file = _File.model_validate(json.loads(path.read_bytes().decode("utf-8-sig")))
    except OSError as error:
        raise DatasetError(f"{path} cannot be read ({error.strerror}).") from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the whole"
        raise DatasetError(f"{path} is no file of poses: {place}: {first['msg']}.") from None
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{path} is no JSON ({error}); write it anew.") from None
    if not file.frames:
        raise DatasetError(f"{path} has no frames; write it anew.")
    return file


def _follow_lists(path: Path, file: _File, notes: list[str]) -> tuple[_File, list[str] | None]:
    """Return the file without the frames that its lists leave out, and the names to hold out.

    These are those to test with, or else those to validate with; None where the file lists none of either
    kind. Trained on are those that are listed for it, or else all that are in no list.
    """
    lists = file.train_filenames, file.test_filenames, file.val_filenames
    training, test, validation = ({photograph_name(name) for name in names or ()} for names in lists)
    held = test or validation
    if not training:
        training = {photograph_name(frame.file_path) for frame in file.frames} - test - validation
    taken = training | held
    left_out = [each.file_path for each in file.frames if photograph_name(each.file_path) not in taken]
    kept = [frame for frame in file.frames if photograph_name(frame.file_path) in taken]
    if left_out:
        notes.append(
            f"{path} lists {len(left_out)} photographs neither for training nor to be held out; they are "
            f"left out ({name_list(left_out, _MAX_NAMES)})."
        )
    names = file.test_filenames or file.val_filenames
    held_out = None if names is None else [photograph_name(name) for name in names]
    return file.model_copy(update={"frames": kept}), held_out


def _unsized_photographs(files: Sequence[_File]) -> list[str]:
    """Return the names of the photographs that the files do not say the size of, each once."""
    names = (
        photograph_name(frame.file_path)
        for file in files
        for frame in file.frames
        if not _lens_values(file, frame).keys() >= _SIZE_KEYS
    )
    return list(dict.fromkeys(names))


def _lens_values(file: _File, frame: _Frame) -> dict[str, Any]:
    """Return the values of a frame's lens that are given, for it or for all frames."""
    own = {key: value for key in _LENS_KEYS if (value := getattr(frame, key)) is not None}
    common = {key: value for key in _LENS_KEYS if (value := getattr(file, key)) is not None}
    if own.keys() & _FOCAL_KEYS:  # one lens: nothing of another one's focal length belongs to it
        common = {key: value for key, value in common.items() if key not in _FOCAL_KEYS}
    return common | own


def _camera_of_frame(
    path: Path, file: _File, frame: _Frame, sizes_px: Mapping[str, tuple[int, int]]
) -> tuple[str, int, int, tuple[float, ...]]:
    """Return model, width, height and parameters of the camera of a frame, in COLMAP's terms."""
    values = _lens_values(file, frame)
    if values.keys() >= _SIZE_KEYS:
        width, height = int(values["w"]), int(values["h"])
    else:
        width, height = sizes_px[photograph_name(frame.file_path)]
    name = str(values.get("camera_model", "OPENCV")).upper()
    name = "OPENCV_FISHEYE" if values.get("is_fisheye") or name in _FISHEYES else name
    if name == _PANORAMA:
        return name, width, height, (float(width), float(height))
    if name not in _PINHOLES | _LENSES | _FISHEYES:
        raise DatasetError(
            f"{path} names the camera model {name[:40]} for {frame.file_path}, which is not read; undistort "
            "the photographs, or give a COLMAP model in sparse/0."
        )
    focal = _focal_length_px(values, "x", width) or _focal_length_px(values, "y", height)
    if focal is None:
        raise DatasetError(
            f"{path} says no focal length for {frame.file_path}; give fl_x (in pixels) or camera_angle_x."
        )
    fx, fy = focal, _focal_length_px(values, "y", height) or focal
    cx, cy = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    k1, k2, k3, k4, p1, p2 = (float(values.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if name == "OPENCV_FISHEYE":
        if p1 or p2:
            raise _unknown_lens(path, frame, "p1 and p2 of a fisheye")
        return name, width, height, (fx, fy, cx, cy, k1, k2, k3, k4)
    if k4:
        raise _unknown_lens(path, frame, "k4 of a lens that is no fisheye")
    if name in _PINHOLES or not any((k1, k2, k3, p1, p2)):
        return "PINHOLE", width, height, (fx, fy, cx, cy)
    if k3:
        # Only the rational model has k3; its denominator stays 1.
        return "FULL_OPENCV", width, height, (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return "OPENCV", width, height, (fx, fy, cx, cy, k1, k2, p1, p2)


def _focal_length_px(values: Mapping[str, Any], axis: str, side_px: int) -> float | None:
    if f"fl_{axis}" in values:
        return float(values[f"fl_{axis}"])
    if f"camera_angle_{axis}" in values:
        return side_px / (2 * math.tan(values[f"camera_angle_{axis}"] / 2))
    return None


def _unknown_lens(path: Path, frame: _Frame, what: str) -> DatasetError:
    return DatasetError(
        f"{path} gives {what} for {frame.file_path}, which is not read; undistort the photographs, or give a "
        "COLMAP model in sparse/0."
    )


def _posed_image(path: Path, frame: _Frame, number: int, name: str, camera_id: int) -> ImageRecord:
    world_from_cam = np.array(frame.transform_matrix[:3])
    rotation = world_from_cam[:, :3].copy()
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if off > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise DatasetError(
            f"{path} gives {frame.file_path} a transform_matrix that is no rigid motion (it scales, shears "
            "or mirrors); write the poses anew."
        )
    # The axes of the camera: from y up and -z ahead to y down and z ahead
    rotation[:, 1:] *= -1
    cam_from_world = rotation.T
    x, y, z, w = pycolmap.Rotation3d(np.ascontiguousarray(cam_from_world)).quat.tolist()
    translation = tuple((-cam_from_world @ world_from_cam[:, 3]).tolist())
    nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
    return ImageRecord(number, (w, x, y, z), translation, camera_id, name, *nothing)


def _read_points(path: Path, named: str | None, notes: list[str]) -> dict[int, PointRecord]:
    if named is None:
        return {}
    # Nothing outside the folder of the scene is read, whatever a file from elsewhere asks for.
    ply = path.with_name(Path(named.replace("\\", "/")).name)
    if not ply.is_file():
        notes.append(f"{path} names points in {named}, which is not there; put {ply.name} beside it.")
        return {}
    try:
        vertices = read_ply(ply, ("vertex",))[1]["vertex"]
        xyz = np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)
    except (SceneFileError, ValueError, KeyError) as error:
        raise DatasetError(f"The points of {path} cannot be read: {error}") from None
    rgb = _point_colors(vertices, len(xyz))
    return {
        number: PointRecord(number, tuple(place), tuple(color), -1.0, ())
        for number, (place, color) in enumerate(zip(xyz.tolist(), rgb.tolist(), strict=True), start=1)
    }


def _point_colors(vertices: np.ndarray, count: int) -> Int64[np.ndarray, "n 3"]:
    names = ("red", "green", "blue")
    if not set(names) <= set(vertices.dtype.names or ()):
        return np.full((count, 3), 128, np.int64)
    rgb = np.stack([vertices[name].astype(np.float64) for name in names], axis=1)
    is_share = vertices.dtype[names[0]].kind == "f" and rgb.max(initial=0) <= 1
    return np.clip(np.rint(rgb * (255 if is_share else 1)), 0, 255).astype(np.int64)


def _unread_keys(paths: Sequence[Path], files: Sequence[_File]) -> list[str]:
    """Return sentences on what the files say that is not read."""
    notes = []
    for path, file in zip(paths, files, strict=True):
        unread = set(file.model_extra or ())
        for frame in file.frames:
            unread |= set(frame.model_extra or ())
        if unread := unread - _NO_MATTER:
            names = sorted(unread)
            shown = ", ".join(names[:_MAX_NAMES]) + (", ..." if len(names) > _MAX_NAMES else "")
            notes.append(f"{path} has values that are not used ({shown}).")
    return notes
