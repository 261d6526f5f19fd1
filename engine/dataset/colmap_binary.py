"""Check of the structure of COLMAP's binary files.

COLMAP's own reader accepts a truncated file without complaint, or asks for absurd amounts of memory.
"""

import mmap
import struct
from pathlib import Path
from typing import Any

import pycolmap

from octasplat.engine.core.errors import DatasetError


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
    if 51 * count > len(data):
        raise struct.error("points missing")
    position = 8
    track_length = struct.Struct("<Q")
    for _ in range(count):
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
