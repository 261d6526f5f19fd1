"""COLMAP's binary files: a look over their structure, and a reader for those that its own one stops at.

COLMAP's reader takes a file that ends too early without complaint, or asks for absurd amounts of memory; it
refuses points that name images which are not there.
"""

import mmap
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float64, Int64

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset.colmap_records import CameraRecord, ImageRecord, ModelRecords, PointRecord

_Record = TypeVar("_Record")
Observations = tuple[Float64[np.ndarray, "k 2"], Int64[np.ndarray, " k"]]
"""Positions in an image and ids of the points that are seen there."""
_NO_POINT = -1


def check_binary_colmap_model(folder: Path) -> None:
    """Check that the binary files of the model in ``folder`` are complete.

    Raises:
        DatasetError: a file ends too early or late, or names a camera model that is not known.
    """
    for name, walk in _SCANNERS.items():
        path = folder / name
        if not path.exists():
            continue
        try:
            # an empty file cannot be mapped
            data = path.read_bytes() if path.stat().st_size < 4096 else _memory_map(path)
            end = walk(data, path)
        except (struct.error, OverflowError):
            raise DatasetError(
                f"{path} is damaged: it ends before all that it announces; copy it anew or run COLMAP again."
            ) from None
        except OSError as error:
            raise DatasetError(f"{path} cannot be read ({error.strerror}).") from error
        if end != len(data):
            raise DatasetError(
                f"{path} is damaged: its contents do not fill its {len(data)} bytes; "
                "copy it anew or run COLMAP again."
            )


def read_binary_model(folder: Path) -> ModelRecords:
    """Read the files of a whole binary model, see :func:`check_binary_colmap_model`.

    Raises:
        DatasetError: an id comes twice, or an image has a camera that is not there or a name that is no text.
    """
    cameras = _by_id(folder / "cameras.bin", _read_cameras, "camera")
    images = _by_id(folder / "images.bin", _read_images, "image")
    for image in images.values():
        if image.camera_id not in cameras:
            raise DatasetError(
                f"{folder / 'images.bin'} names camera {image.camera_id} for {image.name}, which is not in "
                "cameras.bin; copy both files from one model."
            )
    points = _by_id(folder / "points3D.bin", _read_points, "point")
    rigs = [f"Rigs of the model in {folder} are not used; the poses in images.bin are taken."]
    has_rigs = any((folder / f"{part}.bin").is_file() for part in ("rigs", "frames"))
    return ModelRecords(cameras, images, points, tuple(rigs * has_rigs))


def read_binary_observations(path: Path) -> dict[int, Observations]:
    """Return the observations of points in a whole ``images.bin``, by the ids of their images."""
    data, found = _memory_map(path), {}
    for position, _, values in _image_records(data):
        shown = values[values["point"] != _NO_POINT]
        (image_id,) = _unpack("I", data, position)
        found[image_id] = (shown["px"].astype(np.float64), shown["point"].astype(np.int64))
    return found


def _by_id(
    path: Path, read: Callable[[Any, Path], Iterator[tuple[int, _Record]]], what: str
) -> dict[int, _Record]:
    records: dict[int, _Record] = {}
    for number, record in read(path.read_bytes(), path):
        if number in records:
            raise DatasetError(f"{path} has {what} {number} twice; copy it anew or run COLMAP again.")
        records[number] = record
    return records


def _read_cameras(data: bytes, path: Path) -> Iterator[tuple[int, CameraRecord]]:
    names = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items()}
    position = 8  # behind the number of records
    for _ in range(_unpack("Q", data, 0)[0]):
        # CAMERA_ID, MODEL_ID, WIDTH, HEIGHT
        camera_id, model, width, height = _unpack("IiQQ", data, position)
        count = len(pycolmap.Camera.create_from_model_name(0, names[model], 1.0, 1, 1).params)
        params = _unpack(f"{count}d", data, position + 24)
        position += 24 + 8 * count
        yield camera_id, CameraRecord(camera_id, names[model], width, height, params)


def _image_records(data: Any) -> Iterator[tuple[int, int, Any]]:
    """Yield where each image begins, where its name ends, and its rows of ``px`` and ``point``."""
    shown = np.dtype([("px", "<f8", 2), ("point", "<i8")])
    position = 8
    for _ in range(_unpack("Q", data, 0)[0]):
        end_of_name = data.find(b"\0", position + 64)
        (count,) = _unpack("Q", data, end_of_name + 1)
        yield position, end_of_name, np.frombuffer(data, shown, count, end_of_name + 9)
        position = end_of_name + 9 + shown.itemsize * count


def _read_images(data: bytes, path: Path) -> Iterator[tuple[int, ImageRecord]]:
    for position, end_of_name, values in _image_records(data):
        # IMAGE_ID, rotation, translation, CAMERA_ID
        image_id, *numbers, camera_id = _unpack("I7dI", data, position)
        try:
            name = data[position + 64 : end_of_name].decode()
        except UnicodeDecodeError:
            raise DatasetError(
                f"{path} names image {image_id} otherwise than in UTF-8; rename the photograph in plain "
                "letters and run COLMAP again."
            ) from None
        yield (
            image_id,
            ImageRecord(
                image_id=image_id,
                quaternion_wxyz=tuple(numbers[:4]),
                translation=tuple(numbers[4:]),
                camera_id=camera_id,
                name=name,
                observed_px=values["px"].astype(np.float64),
                observed_point_ids=values["point"].astype(np.int64),
            ),
        )


def _read_points(data: bytes, path: Path) -> Iterator[tuple[int, PointRecord]]:
    position = 8
    for _ in range(_unpack("Q", data, 0)[0]):
        # POINT3D_ID, X Y Z, R G B, ERROR, length of the track
        point_id, *numbers, length = _unpack("Q3d3BdQ", data, position)
        xyz, rgb, error = tuple(numbers[:3]), tuple(numbers[3:6]), numbers[6]
        track = _unpack(f"{2 * length}I", data, position + 51)
        position += 51 + 8 * length
        pairs = tuple(zip(track[::2], track[1::2], strict=True))
        yield point_id, PointRecord(point_id, xyz, rgb, error, pairs)


def _memory_map(path: Path) -> mmap.mmap:
    with path.open("rb") as handle:
        return mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ)


def _unpack(layout: str, data: Any, position: int) -> tuple[Any, ...]:
    return struct.unpack_from("<" + layout, data, position)


def _scan_cameras(data: Any, path: Path) -> int:
    (count,) = _unpack("Q", data, 0)
    position = 8
    models = {int(model): name for name, model in pycolmap.CameraModelId.__members__.items()}
    for _ in range(count):
        _, model, _, _ = _unpack("IiQQ", data, position)
        if models.get(model, "INVALID") == "INVALID":
            raise DatasetError(
                f"{path} names the camera model number {model}, which is not a model of COLMAP's."
            )
        params = pycolmap.Camera.create_from_model_name(0, models[model], 1.0, 1, 1).params
        _unpack(f"{len(params)}d", data, position + 24)
        position += 24 + 8 * len(params)
    return position


def _scan_images(data: Any, path: Path) -> int:
    (count,) = _unpack("Q", data, 0)
    position = 8
    for _ in range(count):
        _unpack("I7dI", data, position)
        end_of_name = data.find(b"\0", position + 64)
        if end_of_name < 0:
            raise struct.error("name without end")
        (observations,) = _unpack("Q", data, end_of_name + 1)
        position = end_of_name + 9 + 24 * observations
        if position > len(data):
            raise struct.error("observations missing")
    return position


def _scan_points(data: Any, path: Path) -> int:
    (count,) = _unpack("Q", data, 0)
    # Before the loop, which a damaged count could keep busy for billions of rounds
    if 51 * count > len(data):
        raise struct.error("points missing")
    position = 8
    track_length = struct.Struct("<Q")
    for _ in range(count):
        # The length of the track comes after 43 bytes of id, position, color and error.
        position += 51 + 8 * track_length.unpack_from(data, position + 43)[0]
    if position > len(data):
        raise struct.error("points missing")
    return position


def _scan_rigs(data: Any, path: Path) -> int:
    (count,) = _unpack("Q", data, 0)
    position = 8
    for _ in range(count):
        _, sensors = _unpack("II", data, position)
        position += 8
        for sensor in range(sensors):
            _unpack("iI", data, position)
            position += 8
            # The first sensor is the reference of its rig and has no pose; others may have one, of 7 doubles.
            if sensor > 0:
                (has_pose,) = _unpack("B", data, position)
                position += 1 + (56 if has_pose else 0)
    if position > len(data):
        raise struct.error("rigs missing")
    return position


def _scan_frames(data: Any, path: Path) -> int:
    (count,) = _unpack("Q", data, 0)
    position = 8
    for _ in range(count):
        # After FRAME_ID, RIG_ID and a pose of 7 doubles
        (members,) = _unpack("I", data, position + 64)
        position += 68 + 16 * members
    if position > len(data):
        raise struct.error("frames missing")
    return position


_SCANNERS = {
    "cameras.bin": _scan_cameras,
    "images.bin": _scan_images,
    "points3D.bin": _scan_points,
    "rigs.bin": _scan_rigs,
    "frames.bin": _scan_frames,
}
