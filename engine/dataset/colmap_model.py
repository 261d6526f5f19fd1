"""Reader of COLMAP models, with or without rigs, binary or text."""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin, choose_origin
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.colmap_binary import Observations
from octasplat.engine.dataset.colmap_reading import LoadedModel, load_model
from octasplat.engine.dataset.model import SparsePoints
from octasplat.engine.dataset.pose_check import check_poses

MIN_QUATERNION_NORM = 1e-6
"""Quaternions shorter than this say nothing about a rotation."""
ROUNDING = 1e-9
"""Camera centres no farther apart than this share of their coordinates stand in one place."""
_POINT = np.dtype(
    [
        ("id", np.uint64),
        ("xyz", np.float64, 3),
        ("color", np.uint8, 3),
        ("track", np.int32),
        ("error", np.float64),
    ]
)
UNIT_NORM_TOLERANCE = 1e-9
"""Lengths of quaternions this near to 1 need no correction."""
WARN_NORM_TOLERANCE = 1e-3
"""Lengths of quaternions this near to 1 are of unit ones that a text file rounded: not worth telling."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """A registered image of the model: its name, its camera's id, its pose, and the points it shows.

    Attributes:
        observed_px: where it shows points, at the size COLMAP worked with.
        observed_point_ids: COLMAP's numbers of these.
    """

    name: str
    camera_id: int
    rotation_cam_from_world: Float64[np.ndarray, "3 3"]
    translation_cam_from_world: Float64[np.ndarray, "3"]
    observed_px: Float64[np.ndarray, "k 2"]
    observed_point_ids: Int64[np.ndarray, " k"]


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """The content of a COLMAP model, checked to be finite.

    Attributes:
        folder: where it was read from.
        cameras: by COLMAP's camera id, at the size COLMAP worked with.
        images: registered images, sorted by name.
        points: sparse point cloud.
        warnings: one sentence each on what is odd but usable.
        origin_world: where poses and points have their origin in the coordinates of the files, see
            :mod:`octasplat.engine.core.local_origin`.
        held_out: names of the images that the model's files hold out; None where they do not say.
        masks: paths of masks that the files name, by the names of their images.
        depths: paths of depth maps, likewise.
    """

    folder: Path
    cameras: dict[int, Camera]
    images: tuple[PosedImage, ...]
    points: SparsePoints
    warnings: tuple[str, ...]
    origin_world: Origin = NO_ORIGIN
    held_out: tuple[str, ...] | None = None
    masks: Mapping[str, str] = field(default_factory=dict)
    depths: Mapping[str, str] = field(default_factory=dict)


def read_colmap_model(
    folder: Path,
    *,
    origin_world: Origin | None = None,
    sizes_px: Mapping[str, tuple[int, int]] | None = None,
) -> ColmapModel:
    """Read a COLMAP model, or poses of a transforms file.

    Args:
        folder: of the model, or a transforms file; see :mod:`octasplat.engine.dataset.model_sources`.
        origin_world: local origin to take, that of a scene that the model goes with; None chooses one where
            coordinates are large.
        sizes_px: see :func:`octasplat.engine.dataset.colmap_reading.load_model`.

    Raises:
        DatasetError: the model lacks something, is damaged, or it holds values that are not finite.
    """
    return colmap_model_of(load_model(folder, sizes_px), folder, origin_world=origin_world)


def colmap_model_of(loaded: LoadedModel, folder: Path, *, origin_world: Origin | None = None) -> ColmapModel:
    """Return the content of a model that is loaded already, whose quaternions are normalised in place.

    Arguments and errors are those of :func:`read_colmap_model`.
    """
    reconstruction, warnings = loaded.reconstruction, list(loaded.notes)
    _normalise_quaternions(reconstruction, folder, warnings)
    images = _posed_images(loaded, folder, warnings)
    cameras = _convert_cameras(reconstruction, {image.camera_id for image in images}, folder, warnings)
    columns = _point_columns(reconstruction)
    points_world = columns["xyz"]
    # Local coordinates are taken in 64 bits, before anything is rounded to 32.
    origin = _local_origin(images, points_world) if origin_world is None else origin_world
    images = tuple(_about_origin(image, origin) for image in images)
    points = _sparse_points(columns, points_world - np.array(origin), folder, warnings)
    if images:
        rotations = np.stack([image.rotation_cam_from_world for image in images])
        translations = np.stack([image.translation_cam_from_world for image in images])
        names = [image.name for image in images]
        warnings += check_poses(folder, names, rotations, translations, points)
    return ColmapModel(
        folder=folder,
        cameras=cameras,
        images=images,
        points=points,
        warnings=tuple(warnings),
        origin_world=origin,
        held_out=loaded.held_out,
        masks=loaded.masks,
        depths=loaded.depths,
    )


def _normalise_quaternions(reconstruction: Any, folder: Path, warnings: list[str]) -> None:
    """Normalise the quaternions of frames and rigs before poses are composed of them.

    pycolmap composes poses of any quaternions, even of zeros.
    """
    scaled = 0
    for frame in reconstruction.frames.values():
        if not frame.has_pose:
            continue
        length = frame.rig_from_world.rotation.norm()
        if not length > MIN_QUATERNION_NORM or not math.isfinite(length):
            names = sorted(reconstruction.images[data.id].name for data in frame.image_ids)
            raise DatasetError(
                f"The pose of {' and '.join(names)} in {folder} has the rotation quaternion "
                f"{_quaternion_wxyz(frame.rig_from_world)}, which is no rotation; "
                "run COLMAP again or remove the image."
            )
        frame.rig_from_world, off = _with_unit_rotation(frame.rig_from_world)
        scaled += off
    for rig in reconstruction.rigs.values():
        for sensor, pose in dict(rig.non_ref_sensors).items():
            if pose is None:
                continue
            length = pose.rotation.norm()
            if not length > MIN_QUATERNION_NORM or not math.isfinite(length):
                raise DatasetError(
                    f"Camera {sensor.id} of rig {rig.rig_id} in {folder} has the rotation quaternion "
                    f"{_quaternion_wxyz(pose)}, which is no rotation; run COLMAP again."
                )
            unit, off = _with_unit_rotation(pose)
            rig.set_sensor_from_rig(sensor, unit)
            scaled += off
    if scaled:
        warnings.append(
            f"{scaled} rotations of the model in {folder} were quaternions of another length than 1 "
            "and were normalised."
        )


def _with_unit_rotation(pose: Any) -> tuple[Any, bool]:
    """Return ``pose`` with its quaternion normalised, and whether that deserves a warning."""
    length = pose.rotation.norm()
    if abs(length - 1) <= UNIT_NORM_TOLERANCE:
        return pose, False
    unit = pycolmap.Rotation3d(pose.rotation.quat / length)
    return pycolmap.Rigid3d(unit, pose.translation), abs(length - 1) > WARN_NORM_TOLERANCE


def _quaternion_wxyz(pose: Any) -> str:
    x, y, z, w = pose.rotation.quat.tolist()
    return f"({w:g}, {x:g}, {y:g}, {z:g})"


def _posed_images(loaded: LoadedModel, folder: Path, warnings: list[str]) -> tuple[PosedImage, ...]:
    images: list[PosedImage] = []
    unposed = 0
    for image in loaded.reconstruction.images.values():
        if not image.has_pose:
            unposed += 1
            continue
        matrix = np.array(image.cam_from_world().matrix(), dtype=np.float64)
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:, :3]) - 1) > 1e-3:
            raise DatasetError(
                f"The pose of {image.name} in {folder} is not a finite rigid motion; run COLMAP again."
            )
        known = loaded.observations
        observed = _observations(image) if known is None else known[image.image_id]
        pose = matrix[:, :3].copy(), matrix[:, 3].copy()
        images.append(PosedImage(_image_name(image, folder), int(image.camera_id), *pose, *observed))
    if unposed:
        warnings.append(f"{unposed} images of the model in {folder} have no pose and are left out.")
    names = Counter(image.name for image in images)
    twice = sorted(name for name, count in names.items() if count > 1)
    if twice:
        raise DatasetError(
            f"The model in {folder} has {len(twice)} images twice ({', '.join(twice[:3])}); remove one of "
            "each or run COLMAP again."
        )
    return tuple(sorted(images, key=lambda image: image.name))


def _observations(image: Any) -> Observations:
    """Return the observations of an image of pycolmap."""
    observed = image.get_observation_points2D()
    coordinates = (value for point in observed for value in (point.x(), point.y()))
    observed_px = np.fromiter(coordinates, np.float64, 2 * len(observed)).reshape(-1, 2)
    point_ids = np.fromiter((point.point3D_id for point in observed), np.uint64, len(observed))
    # Beyond what a signed number holds lies only COLMAP's mark for none.
    return observed_px, point_ids.astype(np.int64)


def _image_name(image: Any, folder: Path) -> str:
    try:
        return str(image.name)
    except UnicodeDecodeError:
        raise DatasetError(
            f"The name of image {image.image_id} in {folder} is not UTF-8; save text files as UTF-8, or "
            "rename the photograph in plain letters and run COLMAP again."
        ) from None


def _convert_cameras(
    reconstruction: Any, used: set[int], folder: Path, warnings: list[str]
) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    for camera_id, camera in reconstruction.cameras.items():
        if camera_id not in used:
            continue
        params = np.array(camera.params, dtype=np.float64)
        focals = params[list(camera.focal_length_idxs())]
        valid = camera.verify_params() and np.isfinite(params).all() and (focals > 0).all()
        if not valid or camera.width < 1 or camera.height < 1:
            raise DatasetError(
                f"Camera {camera_id} of the model in {folder} has impossible parameters "
                f"({camera.model_name}, {camera.width}x{camera.height}, {params.tolist()}); run COLMAP again."
            )
        cameras[int(camera_id)] = Camera(
            camera.model_name, tuple(params.tolist()), int(camera.width), int(camera.height)
        )
    idle = reconstruction.num_cameras() - len(cameras)
    if idle:
        warnings.append(f"{idle} cameras of the model in {folder} belong to no posed image.")
    return cameras


def _point_columns(reconstruction: Any) -> np.ndarray:
    """Return the points of a reconstruction by their numbers, as rows of :data:`_POINT`.

    They are read one by one, as objects of Python for millions of them take more memory than the points.
    """
    points = reconstruction.points3D
    rows = (
        (number, point.xyz, point.color, point.track.length(), point.error)
        for number, point in points.items()
    )
    columns = np.fromiter(rows, _POINT, len(points))
    return columns[np.argsort(columns["id"])]


def _local_origin(images: Sequence[PosedImage], points_world: Float64[np.ndarray, "n 3"]) -> Origin:
    """Choose a local origin by the cameras, or by the points where all cameras are in one place."""
    if not images:
        return NO_ORIGIN
    centres = np.stack(
        [-image.rotation_cam_from_world.T @ image.translation_cam_from_world for image in images]
    )
    middle = np.median(centres, axis=0)
    extent = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    finite = points_world[np.isfinite(points_world).all(axis=1)]
    if len(finite):
        # Rounding alone gives cameras in one place a tiny radius.
        to_points = float(np.median(np.linalg.norm(finite - middle, axis=1)))
        extent = extent if extent > 1e-4 * to_points else to_points
    elif extent <= ROUNDING * float(np.linalg.norm(middle)):
        return NO_ORIGIN
    return choose_origin(middle, extent)


def _about_origin(image: PosedImage, origin: Origin) -> PosedImage:
    if origin == NO_ORIGIN:
        return image
    translation = image.translation_cam_from_world + image.rotation_cam_from_world @ np.array(origin)
    return replace(image, translation_cam_from_world=translation)


def _sparse_points(
    columns: np.ndarray, xyz_local: Float64[np.ndarray, "n 3"], folder: Path, warnings: list[str]
) -> SparsePoints:
    xyz = xyz_local.astype(np.float32)
    rgb = columns["color"].astype(np.float32) / np.float32(255)
    tracks = columns["track"]
    errors = columns["error"].astype(np.float32)
    ids = columns["id"].astype(np.int64)
    announced = _declared_point_count(folder / "points3D.txt")
    if not (folder / "points3D.bin").is_file() and announced is not None and announced != len(columns):
        warnings.append(
            f"{folder / 'points3D.txt'} announces {announced} points but holds {len(columns)}; "
            "it may have been cut short."
        )
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.all():
        warnings.append(
            f"{int((~finite).sum())} points of the model in {folder} are not finite and left out."
        )
    return SparsePoints(xyz[finite], rgb[finite], tracks[finite], errors[finite], ids[finite])


def _declared_point_count(path: Path) -> int | None:
    """Return the point count from the header comment of a text file; None if there is none."""
    if not path.is_file():
        return None
    with path.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            if not line.startswith("#"):
                break
            found = re.search(r"Number of points: (\d+)", line)
            if found:
                return int(found.group(1))
    return None
