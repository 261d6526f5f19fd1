"""COLMAP models written byte by byte, so that every number can lie."""

import io
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from PIL import Image

from octasplat.service.intake.dataset import DatasetFile
from octasplat.workers.storage.local import LocalStorage

PINHOLE = 1


@dataclass(frozen=True)
class CameraRecord:
    camera_id: int = 1
    model: int = PINHOLE
    width: int = 32
    height: int = 24
    params: tuple[float, ...] = (30.0, 31.0, 16.0, 12.0)

    def binary(self) -> bytes:
        return struct.pack("<IiQQ", self.camera_id, self.model, self.width, self.height) + struct.pack(
            f"<{len(self.params)}d", *self.params
        )


@dataclass(frozen=True)
class ImageRecord:
    image_id: int
    name: str | bytes
    quat_wxyz: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    translation: tuple[float, ...] = (0.0, 0.0, 4.0)
    camera_id: int = 1
    points: int = 0

    def binary(self) -> bytes:
        name = self.name if isinstance(self.name, bytes) else self.name.encode()
        head = struct.pack("<I7dI", self.image_id, *self.quat_wxyz, *self.translation, self.camera_id)
        observations = struct.pack("<2dq", 1.0, 2.0, -1) * self.points
        return head + name + b"\0" + struct.pack("<Q", self.points) + observations


@dataclass(frozen=True)
class PointRecord:
    point_id: int
    xyz: tuple[float, ...] = (0.0, 0.0, 0.0)

    def binary(self) -> bytes:
        return struct.pack("<Q3d3BdQ", self.point_id, *self.xyz, 1, 2, 3, 0.5, 0)


def rotated_pose(index: int) -> tuple[float, ...]:
    return math.cos(0.1 * index), 0.0, math.sin(0.1 * index), 0.0


@dataclass(frozen=True)
class ColmapModelBuilder:
    """A model of four views; ``counts`` and ``raw`` replace what its files announce or are."""

    cameras: Sequence[CameraRecord] = (CameraRecord(),)
    images: Sequence[ImageRecord] = tuple(
        ImageRecord(i + 1, f"v{i}.png", rotated_pose(i), points=2) for i in range(4)
    )
    points: Sequence[PointRecord] = tuple(PointRecord(i + 1, (0.1 * i, 0.0, 0.0)) for i in range(5))
    counts: dict[str, int] = field(default_factory=dict)
    raw: dict[str, bytes] = field(default_factory=dict)
    folder: str = "sparse/0"

    def with_image(self, **changes: object) -> "ColmapModelBuilder":
        """The same with another first image."""
        first = replace(self.images[0], **changes)  # type: ignore[arg-type]
        return replace(self, images=(first, *self.images[1:]))

    def with_camera(self, **changes: object) -> "ColmapModelBuilder":
        """The same with another camera."""
        return replace(self, cameras=(replace(self.cameras[0], **changes),))  # type: ignore[arg-type]

    def files(self) -> dict[str, bytes]:
        parts = {"cameras": self.cameras, "images": self.images, "points3D": self.points}
        found = {}
        for part, items in parts.items():
            count = struct.pack("<Q", self.counts.get(part, len(items)))
            found[f"{part}.bin"] = count + b"".join(item.binary() for item in items)
        found.update(self.raw)
        return {f"{self.folder}/{name}": data for name, data in found.items() if data != b"absent"}


def photograph(width: int = 32, height: int = 24) -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (width, height), (9, 90, 200)).save(out, "PNG")
    return out.getvalue()


def store_model(storage: LocalStorage, files: dict[str, bytes]) -> list[DatasetFile]:
    """Put files into a store."""
    found = []
    for path, data in files.items():
        with storage.open_writer() as writer:
            writer.write(data)
            blob = writer.commit()
        found.append(DatasetFile(path, blob.sha256, blob.size_bytes))
    return found


def photographs(names: Sequence[str] = ("v0.png", "v1.png", "v2.png", "v3.png")) -> dict[str, bytes]:
    return {f"images/{name}": photograph() for name in names}
