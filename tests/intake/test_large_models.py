"""COLMAP models of very many points are read within the memory that their reader has."""

import struct
from pathlib import Path

import numpy as np
import pytest

from octasplat.service.intake.model_check import ModelLimits, check_model
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.trees import TreeFile

VIEWS = 6
POINTS = 600_000
MEMORY_BYTES = 900 << 20
"""Some 0.6 GB of it are libraries; objects of Python for all points and observations do not fit in too."""
_POINT = np.dtype(
    [
        ("id", "<u8"),
        ("xyz", "<f8", 3),
        ("color", "u1", 3),
        ("error", "<f8"),
        ("n", "<u8"),
        ("track", "<i4", 4),
    ]
)
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


def model_files(points: int) -> dict[str, bytes]:
    """A binary model whose every point is seen by two neighbouring views of a ring of cameras."""
    rng = np.random.default_rng(0)
    number = np.arange(points)
    first, second = number % VIEWS, (number + 1) % VIEWS
    place = number // VIEWS * 2
    rows = np.zeros(points, _POINT)
    rows["id"], rows["xyz"], rows["n"] = number + 1, rng.uniform(-1, 1, (points, 3)), 2
    rows["track"] = np.stack([first + 1, place, second + 1, place + 1], axis=1)
    seen = np.full((VIEWS, 2 * -(-points // VIEWS)), -1)
    seen[first, place] = seen[second, place + 1] = number + 1
    images = [struct.pack("<Q", VIEWS)]
    for view in range(VIEWS):
        angle = 2 * np.pi * view / VIEWS
        pose = np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0, 0.0, 0.0, 4.0
        keypoints = np.zeros(seen.shape[1], _KEYPOINT)
        keypoints["xy"], keypoints["point"] = rng.uniform(0, 480, (seen.shape[1], 2)), seen[view]
        images += [
            struct.pack("<I7dI", view + 1, *pose, 1) + f"{view}.jpg\0".encode(),
            struct.pack("<Q", len(keypoints)) + keypoints.tobytes(),
        ]
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 640, 480, 500.0, 500.0, 320.0, 240.0)
    return {
        "cameras.bin": camera,
        "images.bin": b"".join(images),
        "points3D.bin": struct.pack("<Q", points) + rows.tobytes(),
    }


@pytest.mark.exhaustive
def test_model_of_many_points_fits_into_the_memory_of_its_reader(tmp_path: Path) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    model = []
    for name, content in model_files(POINTS).items():
        with storage.open_writer() as writer:
            writer.write(content)
            blob = writer.commit()
        model.append(TreeFile(path=f"sparse/0/{name}", sha256=blob.sha256, size_bytes=blob.size_bytes))
    sizes = {f"{view}.jpg": (640, 480) for view in range(VIEWS)}
    answer = check_model(storage, model, sizes, ModelLimits(memory_bytes=MEMORY_BYTES))
    assert (answer.faults, answer.views, answer.points) == ([], VIEWS, POINTS)
