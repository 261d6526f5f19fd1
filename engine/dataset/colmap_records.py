"""The contents of a COLMAP model as plain records, where COLMAP's own reader stops or misreads."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64

from octasplat.engine.core.colmap_binding import pycolmap

NO_POINT = -1
"""Stands for the point of an observation that has none."""


@dataclass(frozen=True)
class CameraRecord:
    """A camera as its file has it."""

    camera_id: int
    model: str
    width_px: int
    height_px: int
    params: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ImageRecord:
    """An image with its pose and what it shows.

    Attributes:
        image_id: COLMAP's number.
        quaternion_wxyz: rotation from world to camera coordinates, of any length.
        translation: from world to camera coordinates.
        camera_id: COLMAP's number of its camera.
        name: below the folder of the images.
        observed_px: where it shows points.
        observed_point_ids: COLMAP's numbers of these, or :data:`NO_POINT`.
    """

    image_id: int
    quaternion_wxyz: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
    name: str
    observed_px: Float64[np.ndarray, "k 2"]
    observed_point_ids: Int64[np.ndarray, " k"]


@dataclass(frozen=True)
class PointRecord:
    """A sparse point; its track has the image and the index of each observation."""

    point_id: int
    xyz: tuple[float, ...]
    rgb: tuple[int, ...]
    error_px: float
    track: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class ModelRecords:
    """A whole model, ids unique, and sentences on what was read otherwise than it stands there."""

    cameras: dict[int, CameraRecord]
    images: dict[int, ImageRecord]
    points: dict[int, PointRecord]
    repairs: tuple[str, ...]


def build_reconstruction(records: ModelRecords) -> tuple[Any, int]:
    """Return a reconstruction of pycolmap with the same contents, each image in a rig of its own.

    Observations count where the image and the point both say so; all points and poses are kept.

    Returns:
        The reconstruction, and how many entries of tracks name an image or an observation that is not there.
    """
    model: Any = pycolmap.Reconstruction()
    for camera in records.cameras.values():
        made = pycolmap.Camera(
            camera_id=camera.camera_id,
            model=camera.model,
            width=camera.width_px,
            height=camera.height_px,
            params=list(camera.params),
        )
        model.add_camera_with_trivial_rig(made)
    for image in records.images.values():
        w, x, y, z = image.quaternion_wxyz
        # Quaternions of pycolmap end with w.
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), np.array(image.translation))
        model.add_image_with_trivial_frame(
            pycolmap.Image(
                name=image.name,
                keypoints=image.observed_px,
                camera_id=image.camera_id,
                image_id=image.image_id,
            ),
            pose,
        )
    foreign = 0
    for point in records.points.values():
        track = pycolmap.Track()
        # An observation that a track names twice counts once.
        for image_id, index in dict.fromkeys(point.track):
            holder = records.images.get(image_id)
            if (
                holder is not None
                and 0 <= index < len(holder.observed_point_ids)
                and holder.observed_point_ids[index] == point.point_id
            ):
                track.add_element(image_id, index)
            else:
                foreign += 1
        made_point = pycolmap.Point3D()
        made_point.xyz, made_point.color = np.array(point.xyz), np.array(point.rgb, np.uint8)
        made_point.error, made_point.track = point.error_px, track
        model.add_point3D_with_id(point.point_id, made_point)
    return model, foreign
