"""Cameras of the photographs, read from the COLMAP model of a job, as starting views of the viewer.

The model was validated by a child process when its dataset was committed, or was written by our own worker.
Only the heads of its records are read here, with bounds on all of them; a camera with invalid numbers is
left out.
"""

import io
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import IO, Any

import numpy as np
from jaxtyping import Float64

from octasplat.engine.render.upright import estimate_up

MAX_CAMERAS = 20_000
MAX_VIEWS = 400
"""Most views that the viewer offers; more are thinned evenly."""
_MAX_NAME_BYTES = 4096
_PARAMETER_COUNTS = {
    0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12, 11: 16, 12: 4, 13: 5, 14: 3, 15: 4,
    16: 6, 17: 2,
}  # fmt: skip
"""Number of parameters by COLMAP's camera model number."""
_SINGLE_FOCAL_MODELS = frozenset({0, 2, 3, 8, 9, 12, 14})
_PANORAMA_MODEL, _PANORAMA_NAME = 17, "EQUIRECTANGULAR"
_SINGLE_FOCAL_NAMES = frozenset(
    {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
    | {"SIMPLE_DIVISION", "SIMPLE_FISHEYE"}
)


class CamerasUnreadableError(Exception):
    """The camera files have an unexpected format."""


@dataclass(frozen=True)
class PhotographPose:
    """A photograph's camera.

    Attributes:
        name: of the photograph.
        rotation_cam_from_world: rows are the camera's right, down and forward in the world.
        centre_world: where it stood.
        fov_y_degrees: angle from top to bottom.
        aspect: width over height of what it shows, which is that of its pixels where these are square.
        is_panorama: whether it shows all directions; angle and aspect are then those of its middle.
    """

    name: str
    rotation_cam_from_world: Float64[np.ndarray, "3 3"]
    centre_world: Float64[np.ndarray, "3"]
    fov_y_degrees: float
    aspect: float
    is_panorama: bool = False


def read_poses(cameras: IO[bytes], images: IO[bytes], *, binary: bool) -> list[PhotographPose]:
    """Return the posed photographs of a model, by name.

    Args:
        cameras: ``cameras.bin`` or ``cameras.txt``.
        images: ``images.bin`` or ``images.txt``; the observations in it are skipped.
        binary: which of the two.

    Raises:
        CamerasUnreadableError: the files are cut short or hold something else.
    """
    try:
        intrinsics = _read_cameras_bin(cameras) if binary else _read_cameras_txt(cameras)
        records = _read_images_bin(images) if binary else _read_images_txt(images)
        poses = [pose for record in records if (pose := _pose_of_image(record, intrinsics)) is not None]
    except (struct.error, ValueError, UnicodeDecodeError, OverflowError, IndexError, EOFError) as error:
        raise CamerasUnreadableError(str(error)) from None
    return sorted(poses, key=lambda pose: pose.name)


def read_view_poses(content: Mapping[str, Any]) -> list[PhotographPose]:
    """Return the posed photographs of a run's ``views.json``, by name; none where it holds something else."""
    try:
        poses = [_pose_of_view(view, content["cameras"]) for view in content["views"][:MAX_CAMERAS]]
    except (KeyError, IndexError, TypeError, ValueError):
        return []
    return sorted((pose for pose in poses if pose is not None), key=lambda pose: pose.name)


def _pose_of_view(view: Mapping[str, Any], cameras: Sequence[Mapping[str, Any]]) -> PhotographPose | None:
    camera = cameras[view["camera"]]
    intrinsics = _named_intrinsics(camera["model"], camera["width_px"], camera["height_px"], camera["params"])
    rotation = np.array(view["rotation_cam_from_world"], np.float64)
    translation = np.array(view["translation_cam_from_world"], np.float64)
    if intrinsics is None or not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
        return None
    # A point of the world is R p + t in the camera, so that the camera's own place is -R' t.
    centre = -rotation.T @ translation
    return _photograph_pose(str(view["name"]), rotation, centre, intrinsics)


def viewer_cameras(
    poses: list[PhotographPose],
    held_out: Iterable[str] = (),
    nearest_world: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, object]:
    """Return what the viewer needs: the up direction, a point to look at, and the views, as JSON values.

    Args:
        poses: of the photographs.
        held_out: names of those that training never sees.
        nearest_world: the distance at which the sparse points around each camera begin, by name, as far as
            it is known.

    The point to look at is the one nearest to all their optical axes; it
    is pulled before the cameras where these look the same way and share no such point.
    """
    centres = np.stack([pose.centre_world for pose in poses])
    rotations = np.stack([pose.rotation_cam_from_world for pose in poses])
    forwards = rotations[:, 2]
    up = estimate_up(rotations)
    middle = centres.mean(axis=0)
    # All cameras at one place: any length will do.
    spread = float(np.linalg.norm(centres - middle, axis=1).mean()) or 1.0
    # Least squares of the distances to the axes; the small term keeps parallel axes solvable.
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]
    ahead = middle + forwards.mean(axis=0) * spread
    weight = 1e-3 * len(poses)
    target = np.linalg.solve(
        across.sum(axis=0) + weight * np.eye(3),
        (across @ centres[:, :, None]).sum(axis=0)[:, 0] + weight * ahead,
    )
    depth = np.einsum("ij,ij->i", target - centres, forwards)
    if np.median(depth) < 0.1 * spread:
        target, depth = ahead, np.einsum("ij,ij->i", ahead - centres, forwards)
    held = set(held_out)
    selected = _thinned(poses, held)
    return {
        "up": _round_values(up),
        "target": _round_values(target),
        "radius": round(float(np.median(np.linalg.norm(target - centres, axis=1))) or 1.0, 6),
        "views": [
            {
                "name": pose.name,
                "position": _round_values(pose.centre_world),
                "forward": _round_values(pose.rotation_cam_from_world[2]),
                # The second row is the camera's down.
                "up": _round_values(-pose.rotation_cam_from_world[1]),
                "fov_y_degrees": round(pose.fov_y_degrees, 4),
                "aspect": round(pose.aspect, 5),
                "panorama": pose.is_panorama,
                "held_out": pose.name in held,
                "nearest_world": nearest_world.get(pose.name, 0.0),
            }
            for pose in selected
        ],
    }


def _thinned(poses: Sequence[PhotographPose], held: Collection[str]) -> list[PhotographPose]:
    """Return at most ``MAX_VIEWS`` from all over the photographs, in their order.

    Held-out ones are kept before others, as far as they leave half of the places for these.
    """
    if len(poses) <= MAX_VIEWS:
        return list(poses)
    is_held = [pose.name in held for pose in poses]
    held_rows = [k for k, hold in enumerate(is_held) if hold]
    other_rows = [k for k, hold in enumerate(is_held) if not hold]
    held_count = min(len(held_rows), max(MAX_VIEWS // 2, MAX_VIEWS - len(other_rows)))
    rows = _evenly(held_rows, held_count) + _evenly(other_rows, MAX_VIEWS - held_count)
    return [poses[k] for k in sorted(rows)]


def _evenly(rows: list[int], count: int) -> list[int]:
    """Return ``count`` of the rows, or all where there are fewer.

    >>> _evenly([0, 1, 2, 3, 4, 5], 3)
    [0, 2, 4]
    """
    return rows if len(rows) <= count else [rows[k * len(rows) // count] for k in range(count)]


@dataclass(frozen=True)
class _Intrinsics:
    """Intrinsics of a camera as the viewer takes them."""

    fov_y_degrees: float
    aspect: float
    is_panorama: bool = False


_PANORAMA_MIDDLE = _Intrinsics(60.0, 1.5, is_panorama=True)
"""What the viewer shows of a panorama where it goes to its place."""
_ImageRecord = tuple[list[float], int, str]
"""Seven numbers of the pose, the camera's id, the name."""


def _named_intrinsics(
    model: str, width: float, height: float, parameters: Sequence[float]
) -> _Intrinsics | None:
    """Return the intrinsics of a camera whose model is named; None where a number is invalid."""
    if model == _PANORAMA_NAME:
        return _PANORAMA_MIDDLE
    return _intrinsics_from_focal(width, height, *_focal_lengths(parameters, model in _SINGLE_FOCAL_NAMES))


def _focal_lengths(parameters: Sequence[float], has_one: bool) -> tuple[float, float]:
    """Return both focal lengths of a camera, the first of its parameters."""
    return float(parameters[0]), float(parameters[0 if has_one else 1])


def _intrinsics_from_focal(width: float, height: float, fx: float, fy: float) -> _Intrinsics | None:
    """Return the vertical field of view and the aspect; None where a number is not positive and finite."""
    numbers = np.array([width, height, fx, fy], np.float64)
    if not ((numbers > 0).all() and np.isfinite(numbers).all()):
        return None
    return _Intrinsics(float(np.degrees(2 * np.arctan(height / (2 * fy)))), width * fy / (height * fx))


def _pose_of_image(record: _ImageRecord, intrinsics: dict[int, _Intrinsics]) -> PhotographPose | None:
    numbers, camera_id, name = record
    quat_wxyz, translation = np.array(numbers[:4]), np.array(numbers[4:7])
    length = np.linalg.norm(quat_wxyz)
    camera = intrinsics.get(camera_id)
    if camera is None or not np.isfinite(numbers).all() or length < 1e-6:
        return None
    w, x, y, z = quat_wxyz / length
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return _photograph_pose(name, rotation, -rotation.T @ translation, camera)


def _photograph_pose(
    name: str,
    rotation: Float64[np.ndarray, "3 3"],
    centre: Float64[np.ndarray, "3"],
    camera: _Intrinsics,
) -> PhotographPose:
    return PhotographPose(name, rotation, centre, camera.fov_y_degrees, camera.aspect, camera.is_panorama)


def _read_cameras_bin(file: IO[bytes]) -> dict[int, _Intrinsics]:
    """Return the intrinsics of COLMAP's ``cameras.bin`` by camera id, without invalid cameras."""
    (count,) = _unpack(file, "<Q")
    _check_record_count(count)
    intrinsics = {}
    for _ in range(count):
        camera_id, model, width, height = _unpack(file, "<iiQQ")
        if model not in _PARAMETER_COUNTS:
            raise ValueError(f"unsupported COLMAP camera model {model}")
        parameters = _unpack(file, f"<{_PARAMETER_COUNTS[model]}d")
        if model == _PANORAMA_MODEL:
            intrinsics[camera_id] = _PANORAMA_MIDDLE
            continue
        found = _intrinsics_from_focal(
            width, height, *_focal_lengths(parameters, model in _SINGLE_FOCAL_MODELS)
        )
        if found is not None:
            intrinsics[camera_id] = found
    return intrinsics


def _read_images_bin(file: IO[bytes]) -> Iterator[_ImageRecord]:
    """Yield the records of COLMAP's ``images.bin``."""
    (count,) = _unpack(file, "<Q")
    _check_record_count(count)
    for _ in range(count):
        # The id of the image, quaternion and translation, the id of the camera.
        _, *numbers, camera_id = _unpack(file, "<i7di")
        name = bytearray()
        while (letter := _read_exactly(file, 1)) != b"\0":
            name += letter
            if len(name) > _MAX_NAME_BYTES:
                raise ValueError("a name without end")
        (points,) = _unpack(file, "<Q")
        # 24 bytes an observation: x, y and the id of its point.
        file.seek(24 * points, io.SEEK_CUR)
        yield [float(number) for number in numbers], camera_id, name.decode()


def _read_cameras_txt(file: IO[bytes]) -> dict[int, _Intrinsics]:
    """Return the intrinsics of COLMAP's ``cameras.txt`` by camera id, without invalid cameras."""
    intrinsics = {}
    for line in _text_lines(file):
        words = line.split()
        if not words:
            continue
        parameters = [float(word) for word in words[4:]]
        found = _named_intrinsics(words[1], float(words[2]), float(words[3]), parameters)
        if found is not None:
            intrinsics[int(words[0])] = found
        _check_record_count(len(intrinsics))
    return intrinsics


def _read_images_txt(file: IO[bytes]) -> Iterator[_ImageRecord]:
    """Yield the records of COLMAP's ``images.txt``."""
    lines = _text_lines(file)
    for line in lines:
        # The name is the rest of the line, as it may hold spaces.
        words = line.split(maxsplit=9)
        if not words:
            continue
        yield [float(word) for word in words[1:8]], int(words[8]), words[9].strip()
        next(lines, "")  # its observations


def _text_lines(file: IO[bytes]) -> Iterator[str]:
    return (line for raw in file if not (line := raw.decode()).startswith("#"))


def _unpack(file: IO[bytes], layout: str) -> tuple[Any, ...]:
    return struct.unpack(layout, _read_exactly(file, struct.calcsize(layout)))


def _read_exactly(file: IO[bytes], count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise EOFError("it ends too early")
    return data


def _check_record_count(count: float) -> None:
    if count > MAX_CAMERAS:
        raise ValueError(f"{count} records")


def _round_values(values: Float64[np.ndarray, " n"]) -> list[float]:
    return [round(float(value), 6) for value in values]
