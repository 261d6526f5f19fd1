"""Records of a photographed dataset without its pixels: views, sparse points, observations and split."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.image_info import ImageInfo


@dataclass(frozen=True, eq=False)
class PosedView:
    """Name, pose and working size of one photograph.

    Attributes:
        name: name in the COLMAP model, relative to ``images/``, with forward slashes.
        camera_index: index into the cameras of the scene.
        rotation_cam_from_world: takes world to camera coordinates (x right, y down, z forward).
        translation_cam_from_world: ``x_cam = rotation @ x_world + translation``, world units.
        width_px: width after the resolution cap.
        height_px: height after the resolution cap.
    """

    name: str
    camera_index: int
    rotation_cam_from_world: Float64[np.ndarray, "3 3"]
    translation_cam_from_world: Float64[np.ndarray, "3"]
    width_px: int
    height_px: int

    @property
    def origin_world(self) -> Float64[np.ndarray, "3"]:
        """Return the centre of projection in world coordinates."""
        return -self.rotation_cam_from_world.T @ self.translation_cam_from_world


@dataclass(frozen=True, eq=False)
class DatasetView(PosedView):
    """One posed photograph at its working size.

    Attributes:
        image_path: the photograph on disk.
        mask_path: ``masks/<name>.png`` where there is one.
        depth_path: its depth map where there is one, see :mod:`octasplat.engine.dataset.depth_maps`.
    """

    image_path: Path
    mask_path: Path | None
    depth_path: Path | None = None


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """The sparse point cloud of structure from motion; it may be empty.

    Attributes:
        xyz_world: positions.
        rgb_srgb: display colors in [0, 1].
        track_lengths: number of observations of each point.
        errors_px: mean reprojection error at the size COLMAP worked with; -1 where it is not known.
        ids: COLMAP's numbers, ascending.
    """

    xyz_world: Float32[np.ndarray, "n 3"]
    rgb_srgb: Float32[np.ndarray, "n 3"]
    track_lengths: Int32[np.ndarray, " n"]
    errors_px: Float32[np.ndarray, " n"]
    ids: Int64[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.xyz_world)

    def rows_of(self, ids: Int64[np.ndarray, " k"]) -> tuple[Int64[np.ndarray, " k"], Bool[np.ndarray, " k"]]:
        """Return the row of each of COLMAP's numbers, and whether there is a point of that number.

        Models name points that are not there, as in a part of a larger model; their rows are any.
        """
        if len(self) == 0:
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), np.bool_)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self) - 1)
        return rows, self.ids[rows] == ids


@dataclass(frozen=True, eq=False)
class Observations:
    """Observations of sparse points in photographs: one row for each pair of view and point.

    Attributes:
        view: index of the view.
        point: COLMAP's number of the point.
        xy_px: where in the picture, at its working size.
    """

    view: Int64[np.ndarray, " k"]
    point: Int64[np.ndarray, " k"]
    xy_px: Float64[np.ndarray, "k 2"]

    def __len__(self) -> int:
        return len(self.view)


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """Poses and cameras of a set of photographs.

    Attributes:
        views: sorted by name.
        cameras: cameras at the working size, without duplicates.
    """

    views: tuple[PosedView, ...]
    cameras: tuple[Camera, ...]


@dataclass(frozen=True, eq=False)
class DatasetModel(Viewpoints):
    """A scene before its pixels are read.

    Attributes:
        views: posed photographs, sorted by name.
        root: folder of the scene.
        model_folder: folder of the COLMAP model in use.
        image_infos: headers of the photographs, in the order of ``views``.
        points: sparse point cloud.
        observations: of the points.
        warnings: one sentence each on what is odd but usable.
        origin_world: where all of it has its origin in the coordinates of the files, see
            :mod:`octasplat.engine.core.local_origin`.
        held_out: names of the views that the scene says are to be held out; None where it says nothing.
    """

    views: tuple[DatasetView, ...]
    root: Path
    model_folder: Path
    image_infos: tuple[ImageInfo, ...]
    points: SparsePoints
    observations: Observations
    warnings: tuple[str, ...]
    origin_world: Origin = NO_ORIGIN
    held_out: tuple[str, ...] | None = None


def scene_extent(origins_world: Float64[np.ndarray, "n 3"], points: SparsePoints) -> float:
    """Return the radius of the camera positions, the unit of learning rates and densification; never 0.

    1.1 times the largest distance of a camera centre to their mean, as in 3D Gaussian Splatting (Kerbl et
    al. 2023), among the centres that are not strays, i.e. not farther than 5 times the median distance from
    the median centre. Cameras that all stand in one place take the median distance of the points instead.
    """
    middle = np.median(origins_world, axis=0)
    distances = np.linalg.norm(origins_world - middle, axis=1)
    typical = float(np.median(distances))
    inliers = origins_world[distances <= 5 * typical] if typical > 0 else origins_world
    centre = inliers.mean(axis=0)
    radius = 1.1 * float(np.linalg.norm(inliers - centre, axis=1).max())
    if len(points) == 0:
        return radius if radius > 0 else 1.0
    to_points = float(np.median(np.linalg.norm(points.xyz_world - centre, axis=1)))
    # Rounding alone gives cameras in one place a tiny radius, hence the comparison with the points.
    if radius > 1e-4 * to_points:
        return radius
    return to_points if to_points > 0 else 1.0
