"""Generated photographs whose place on the Earth is known, with GPS written into them by Pillow."""

from collections.abc import Collection, Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np
import pycolmap
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational
from scipy.spatial.transform import Rotation

from octasplat.engine.dataset import Dataset, load_dataset_model

PLACE = (48.137222, 11.575556, 520.0)
"""Latitude, longitude and height that the scene's origin lies at."""
SCALE = 12.5


def truth_matrix() -> np.ndarray:
    """Metres east, north and up about :data:`PLACE` from the coordinates of the scene."""
    matrix = np.eye(4)
    # from y down to z up, and turned about the vertical by 40 degrees
    upright = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    matrix[:3, :3] = SCALE * Rotation.from_euler("z", 40, degrees=True).as_matrix() @ upright
    matrix[:3, 3] = (3.0, -2.0, 1.5)
    return matrix


def apply(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points after a map."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def camera_centres(scene: Path) -> dict[str, np.ndarray]:
    """Return the centres of the cameras of a model in its own coordinates, by photograph."""
    model = load_dataset_model(scene)
    return {view.name: view.origin_world + np.array(model.origin_world) for view in model.views}


def write_gps(
    scene: Path, metres: Mapping[str, np.ndarray], *, without_altitude: Collection[str] = ()
) -> None:
    """Write positions in metres about :data:`PLACE` into the EXIF of photographs, some without altitude."""
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    for name, position in metres.items():
        latitude, longitude, height = earth.enu_to_ellipsoid(position[None], *PLACE)[0].tolist()
        path = scene / "images" / name
        image = Image.open(path)
        image.load()
        exif = image.getexif()
        exif[ExifTags.IFD.GPSInfo] = {
            ExifTags.GPS.GPSLatitudeRef: "N" if latitude >= 0 else "S",
            ExifTags.GPS.GPSLatitude: _sexagesimal(abs(latitude)),
            ExifTags.GPS.GPSLongitudeRef: "E" if longitude >= 0 else "W",
            ExifTags.GPS.GPSLongitude: _sexagesimal(abs(longitude)),
        }
        if name not in without_altitude:
            exif[ExifTags.IFD.GPSInfo] |= {
                ExifTags.GPS.GPSAltitudeRef: b"\0",
                ExifTags.GPS.GPSAltitude: _rational(height, 10**6),
            }
        image.save(path, exif=exif)


def _sexagesimal(angle: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    degrees, rest = divmod(angle * 60, 60)
    minutes, seconds = divmod(rest * 60, 60)
    return IFDRational(int(degrees), 1), IFDRational(int(minutes), 1), _rational(seconds, 7 * 10**7)


def _rational(value: float, denominator: int) -> IFDRational:
    found = Fraction(round(value * denominator), denominator)
    return IFDRational(found.numerator, found.denominator)


def open_scene(scene: Path, cache: Path) -> Dataset:
    """Return the photographs and their poses."""
    return Dataset.open(scene, cache)


def project(scene: Path, name: str, point: np.ndarray) -> np.ndarray:
    """Return where a photograph shows a point of the scene, in pixels; of a scene without a local origin."""
    model = load_dataset_model(scene)
    view = next(view for view in model.views if view.name == name)
    seen = view.rotation_cam_from_world @ point + view.translation_cam_from_world
    return model.cameras[view.camera_index].project(seen[None])[0]


def metres_about(found: np.ndarray, anchor: tuple[float, float, float]) -> np.ndarray:
    """Return a matrix about another anchor as one about :data:`PLACE`; the axes turn with the Earth."""
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    corners = np.vstack([np.zeros(3), np.eye(3)])
    about = apply(found, corners)
    there = earth.ellipsoid_to_enu(earth.enu_to_ellipsoid(about, *anchor), *PLACE)
    matrix = np.eye(4)
    matrix[:3, 3] = there[0]
    matrix[:3, :3] = (there[1:] - there[0]).T
    return matrix
