from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest

TYPES = {
    np.dtype(np.uint8): "uint8",
    np.dtype(np.uint16): "uint16",
    np.dtype(np.float16): "half",
    np.dtype(np.float32): "float",
}


def _save_image(path: Path, pixels: np.ndarray, **attributes: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.ascontiguousarray(pixels if pixels.ndim == 3 else pixels[..., None])
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, TYPES[pixels.dtype])
    if path.suffix != ".exr":
        spec.attribute("oiio:UnassociatedAlpha", 1)
    for name, value in attributes.items():
        spec.attribute(name, value)
    out = oiio.ImageOutput.create(str(path))
    assert out is not None, oiio.geterror()
    assert out.open(str(path), spec), out.geterror()
    assert out.write_image(pixels), out.geterror()
    out.close()


def look_at_origin(position: np.ndarray) -> pycolmap.Rigid3d:
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0.0, 1.0, 0.1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ position)


def ring_position(index: int, radius: float = 4.0) -> np.ndarray:
    angle = 0.7 * index
    return radius * np.array([np.cos(angle), 0.3, np.sin(angle)])


def _make_scene(
    root: Path,
    *,
    cameras: Sequence[pycolmap.Camera] | None = None,
    images: Sequence[tuple[str, int, np.ndarray | None]] | None = None,
    points: int = 20,
    text: bool = False,
    with_rigs: bool = True,
    folder: str = "sparse/0",
    positions: Callable[[int], np.ndarray] = ring_position,
) -> Path:
    """Write images/ and a model; an image is (name, index of its camera, pixels or None to write none)."""
    if cameras is None:
        cameras = [pycolmap.Camera(model="PINHOLE", width=32, height=24, params=[30.0, 31.0, 16.0, 12.0])]
    if images is None:
        images = [(f"view_{i}.png", 0, coded_image(32, 24, i)) for i in range(4)]
    rng = np.random.default_rng(3)
    model = pycolmap.Reconstruction()
    for index, camera in enumerate(cameras):
        camera.camera_id = index + 1
        model.add_camera_with_trivial_rig(camera)
    world = rng.uniform(-1, 1, (points, 3))
    for index, (name, camera_index, pixels) in enumerate(images):
        image = pycolmap.Image(name=name, camera_id=camera_index + 1, image_id=index + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([1.0, 2.0])) for _ in range(points)])
        model.add_image_with_trivial_frame(image, look_at_origin(positions(index)))
        if pixels is not None:
            _save_image(root / "images" / name, pixels)
    for index, point in enumerate(world):
        track = pycolmap.Track()
        track.add_element(1, index)
        track.add_element(2, index)
        model.add_point3D(point, track, np.array([index, 255, 0], dtype=np.uint8))
    (root / folder).mkdir(parents=True, exist_ok=True)
    (root / "images").mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(root / folder))
    if not with_rigs:
        for part in ("rigs", "frames"):
            (root / folder / f"{part}{'.txt' if text else '.bin'}").unlink()
    return root


def coded_image(width: int, height: int, index: int) -> np.ndarray:
    """An 8-bit image whose red is the column, green the row and blue the number of the image."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[..., 0] = np.arange(width)
    image[..., 1] = np.arange(height)[:, None]
    image[..., 2] = index
    return image


@pytest.fixture
def save_image() -> Callable[..., None]:
    return _save_image


@pytest.fixture
def make_scene() -> Callable[..., Path]:
    return _make_scene


@pytest.fixture
def coded() -> Callable[[int, int, int], np.ndarray]:
    return coded_image
