"""The scene of a run as plain glTF viewers show it right: what was photographed, in an order that suits it.

Viewers frame the bounding box of all vertices. A few Gaussians far away, which few photographs show, make it
many times as large as what the cameras surround, so that the scene opens as a speck.
"""

import math
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.dataset import load_dataset_model
from octasplat.engine.files import read_metadata
from octasplat.engine.files.export_options import ExportCamera, ExportOptions
from octasplat.engine.files.mesh_glb import CORES_IN_ORDER, CORES_OF_CHUNKS
from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import octagon_radii
from octasplat.engine.render.depth_order import MIN_AGREEMENT, shared_depth_order
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.upright import upright_frame
from octasplat.engine.runs.run_folder import CONFIG, is_run, run_viewpoints
from octasplat.engine.surface.depth_cameras import photograph_cameras
from octasplat.engine.surface.region import focus_point

Extent = Literal["photographed", "all"]
CAMERA_SIDE_PX = 1024
OUTLIER_SHARE = 0.005
"""Of all opacity, to each side of an axis, what does not widen the box."""
MARGIN_SHARE = 0.1
MIN_SHARE = 0.05
"""Where less than this share of the Gaussians would stay, all do."""
NEAR_SHARE = 0.01
"""Of the distance between the cameras and what they look at, where sight begins."""


def prepare_for_viewers(
    gaussians: FlatGaussians, source: Path, options: ExportOptions, extent: Extent
) -> tuple[FlatGaussians, ExportOptions]:
    """Return what of a scene to write for viewers, and how.

    In one chunk, in the order of most cameras, where these agree; else in chunks, which viewers sort. The
    camera of a training view goes with it, and the scene is turned upright, its front to the viewer.

    Args:
        gaussians: the scene, with constant colors.
        source: the folder of its run; of a file, no cameras are known, and all of it is written in chunks.
        options: how else to write it.
        extent: whether to write all of it, or what was photographed.

    Raises:
        DatasetError: the cameras of the run are not known any more.
    """
    # numbers of Gaussians are for edits
    options = options.model_copy(update={"ids": False, "cores": CORES_OF_CHUNKS})
    if not _has_cameras(source):
        return gaussians, options
    seen = run_viewpoints(source)
    cameras = photograph_cameras(seen, seen.train_indices, CAMERA_SIDE_PX)
    focus_world, distance = _focus(cameras)
    if extent == "photographed":
        gaussians = gaussians.select(
            np.flatnonzero(photographed(gaussians, focus_world, distance, options.q))
        )
    best = _looks_at(cameras, focus_world)
    names = [seen.views[index].name for index in seen.train_indices]
    options = options.model_copy(
        update={
            "camera": _gltf_camera(
                cameras[best],
                # a panorama has six cameras: names do not match them
                names[best] if len(names) == len(cameras) else "camera",
                NEAR_SHARE * (distance if math.isfinite(distance) else 1.0),
            ),
            "turn_xyzw": _upright_turn(cameras, focus_world),
        }
    )
    centres = np.stack([seen.views[index].origin_world for index in seen.train_indices])
    order, agreement = shared_depth_order(gaussians.means_world, centres)
    if agreement < MIN_AGREEMENT:  # chunks, which the viewer sorts by itself
        return gaussians, options
    return gaussians.select(order), options.model_copy(update={"chunks": 1, "cores": CORES_IN_ORDER})


def upright_turn(source: Path, dataset: Path | None = None) -> tuple[float, float, float, float] | None:
    """Return the rotation (x, y, z, w) by which a scene stands upright in glTF, y up.

    Args:
        source: the folder of a run, or a file of Gaussians.
        dataset: a folder of photographs whose cameras to take; None takes those that a run keeps.

    Returns:
        None where no cameras are known, as of a file alone.

    Raises:
        DatasetError: the cameras of the run are not known any more, or the photographs cannot be used.
    """
    if _has_cameras(source):
        seen = run_viewpoints(source, scene=dataset)
        cameras = photograph_cameras(seen, seen.train_indices, CAMERA_SIDE_PX)
    elif dataset is not None:
        photographs = load_dataset_model(dataset, origin_world=read_metadata(source).origin_world)
        cameras = photograph_cameras(photographs, np.arange(len(photographs.views)), CAMERA_SIDE_PX)
    else:
        return None
    return _upright_turn(cameras, _focus(cameras)[0])


def _has_cameras(source: Path) -> bool:
    return is_run(source) and (source / CONFIG).exists()


def _focus(cameras: tuple[PinholeCamera, ...]) -> tuple[Float64[np.ndarray, "3"], float]:
    """Return what cameras look at, and how far away it is: their mean and infinite where that is nothing."""
    try:
        return focus_point(cameras)
    except ConfigError:
        return np.mean([camera.centre_world for camera in cameras], axis=0), math.inf


def _upright_turn(
    cameras: tuple[PinholeCamera, ...], focus_world: Float64[np.ndarray, "3"]
) -> tuple[float, float, float, float]:
    rotations = np.stack([camera.rotation_cam_from_world for camera in cameras])
    centres = np.stack([camera.centre_world for camera in cameras])
    frame = upright_frame(rotations, centres, focus_world)
    w, x, y, z = quaternions_from_matrices(frame[None])[0].tolist()
    return x, y, z, w


def photographed(
    gaussians: FlatGaussians, focus_world: Float64[np.ndarray, "3"], distance: float, q: float
) -> Bool[np.ndarray, " n"]:
    """Return which Gaussians lie in the space that cameras surround; all, where hardly any do.

    That space is a cube about the point that they look at, as far to each side as they are away; of it, the
    box of what is there, without outliers and with a margin. Octagons lie in it as a whole.

    Args:
        gaussians: the scene.
        focus_world: the point that the cameras look at.
        distance: of the cameras from it; infinite where they look at no common point.
        q: squared radius of an opaque octagon, in standard deviations.
    """
    means = gaussians.means_world.astype(np.float64)
    radii = octagon_radii(gaussians.opacities, q) * np.exp(gaussians.log_scales).max(axis=1)
    # octagons as a whole, not centers: a large one would widen the box
    inside = (np.abs(means - focus_world) + radii[:, None] <= distance).all(axis=1)
    if inside.sum() < max(1, MIN_SHARE * len(gaussians)):
        return np.ones(len(gaussians), bool)
    low, high = _weighted_box(means[inside], gaussians.opacities[inside].astype(np.float64))
    margin = MARGIN_SHARE * float((high - low).max())
    low, high = low - margin, high + margin
    return np.asarray(
        inside & ((means - radii[:, None] >= low) & (means + radii[:, None] <= high)).all(axis=1)
    )


def _weighted_box(
    points: Float64[np.ndarray, "n 3"], weights: Float64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    low, high = np.zeros(3), np.zeros(3)
    for axis in range(3):
        order = np.argsort(points[:, axis])
        share = np.cumsum(weights[order]) / weights.sum()
        ends = np.searchsorted(share, [OUTLIER_SHARE, 1 - OUTLIER_SHARE])
        low[axis], high[axis] = points[order[np.minimum(ends, len(order) - 1)], axis]
    return low, high


def _looks_at(cameras: tuple[PinholeCamera, ...], point_world: Float64[np.ndarray, "3"]) -> int:
    """Return the number of the camera that has a point nearest to the middle of its image."""
    away = point_world - np.stack([camera.centre_world for camera in cameras])
    forwards = np.stack([camera.rotation_cam_from_world[2] for camera in cameras])
    return int(np.argmax((away * forwards).sum(axis=1) / np.maximum(np.linalg.norm(away, axis=1), 1e-12)))


def _gltf_camera(camera: PinholeCamera, name: str, near_world: float) -> ExportCamera:
    axes = camera.rotation_cam_from_world.T @ np.diag([1.0, -1.0, -1.0])  # y up, looking along -z
    w, x, y, z = quaternions_from_matrices(axes[None])[0].tolist()
    px, py, pz = camera.centre_world.tolist()
    return ExportCamera(
        name=name,
        position_world=(px, py, pz),
        rotation_xyzw=(x, y, z, w),
        yfov_rad=2 * math.atan(camera.height_px / (2 * camera.fy_px)),
        aspect=camera.width_px / camera.height_px,
        near_world=near_world,
    )
