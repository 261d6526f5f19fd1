"""Cameras for depth maps: pinholes in the photographs' places, or all around a scene."""

import numpy as np
from jaxtyping import Float64, Int64

from octasplat.engine.dataset import Camera, PosedView, Viewpoints
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.pose_paths import look_at
from octasplat.engine.render.shots import gaussian_turntable

MAX_SLOPE = 1.2
"""Lenses wider than this to a side (50 degrees) are cut there: a pinhole shows nothing well beyond."""
_CUBE_TURNS = (
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
)
"""Right, down and forward of the faces of a cube: ahead, right, behind, left, below, above."""
AROUND_COUNT = 96
AROUND_FOV_DEGREES = 50.0


def photograph_cameras(
    viewpoints: Viewpoints, indices: Int64[np.ndarray, " n"], max_side: int, near_world: float = 0.0
) -> tuple[PinholeCamera, ...]:
    """Return pinhole cameras in place of the photographs', images no larger than ``max_side``.

    They see nothing nearer than ``near_world``.

    A pinhole camera stays as it is but for its size; of a distorted image, the pinhole shows what lies
    between the middles of its sides. A panorama is shown by the six faces of a cube, the one ahead first.
    """
    cameras: list[PinholeCamera] = []
    for index in indices:
        view = viewpoints.views[index]
        camera = viewpoints.cameras[view.camera_index]
        if camera.is_panorama:
            cameras.extend(_cube_faces(view, camera, max_side, near_world))
        else:
            cameras.append(_pinhole_camera(view, camera, max_side, near_world))
    return tuple(cameras)


def cameras_around(
    gaussians: FlatGaussians, max_side: int, count: int = AROUND_COUNT
) -> tuple[PinholeCamera, ...]:
    """Return square cameras spread over a sphere, for a scene of which only Gaussians are known.

    The sphere lies around their median weighted by opacity, so far out that four fifths of all opacity fit
    into an image. Right for an object; what surrounds the viewer (a room) has to be seen from inside.
    """
    table = gaussian_turntable(gaussians, fov_y_degrees=AROUND_FOV_DEGREES)
    distance = float(np.hypot(table.radius, table.height))
    order = np.arange(count)
    # golden angle steps: a Fibonacci sphere
    height, angle = 1 - (2 * order + 1) / count, order * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - height**2)
    outwards = np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
    focal_px = focal_from_fov(AROUND_FOV_DEGREES, max_side)
    return tuple(
        PinholeCamera.from_pose(
            # up must not be along the view
            look_at(table.centre_world + distance * out, table.centre_world, _least_aligned_axis(out)),
            max_side,
            max_side,
            fy_px=focal_px,
        )
        for out in outwards
    )


def _least_aligned_axis(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3"]:
    """Return an axis that is not along ``direction``."""
    return np.eye(3)[int(np.argmin(np.abs(direction)))]


def _cube_faces(
    view: PosedView, camera: Camera, max_side: int, near_world: float
) -> tuple[PinholeCamera, ...]:
    """Return square pinholes of 90 degrees that together see in all directions."""
    side_px = (
        # as fine as the panorama itself, at 90 degrees a face
        max_side if camera.pixel_angle_rad == 0 else max(1, min(max_side, round(2 / camera.pixel_angle_rad)))
    )
    return tuple(
        PinholeCamera(
            width_px=side_px,
            height_px=side_px,
            fx_px=side_px / 2,
            fy_px=side_px / 2,
            cx_px=side_px / 2,
            cy_px=side_px / 2,
            rotation_cam_from_world=turn @ view.rotation_cam_from_world,
            translation_cam_from_world=turn @ view.translation_cam_from_world,
            near_world=near_world,
        )
        for turn in np.array(_CUBE_TURNS, np.float64)
    )


def _pinhole_camera(view: PosedView, camera: Camera, max_side: int, near_world: float) -> PinholeCamera:
    width, height = view.width_px, view.height_px
    scale = min(1.0, max_side / max(width, height))
    width_px, height_px = max(1, round(width * scale)), max(1, round(height * scale))
    if camera.is_pinhole:
        fx, fy, cx, cy = camera.pinhole_params
        left, right, top, bottom = -cx / fx, (width - cx) / fx, -cy / fy, (height - cy) / fy
    else:
        middles = [[0.0, height / 2], [width, height / 2], [width / 2, 0.0], [width / 2, height]]
        directions = camera.directions_cam(np.array(middles))
        # a fisheye's edge may lie behind: the cut takes its place
        ahead = np.isfinite(directions).all(axis=1) & (directions[:, 2] > 0)
        slopes = np.array([-MAX_SLOPE, MAX_SLOPE, -MAX_SLOPE, MAX_SLOPE])
        axis = np.array([0, 0, 1, 1])
        slopes[ahead] = directions[ahead, axis[ahead]] / directions[ahead, 2]
        left, right, top, bottom = np.clip(slopes, -MAX_SLOPE, MAX_SLOPE)
    fx_px, fy_px = width_px / (right - left), height_px / (bottom - top)
    return PinholeCamera(
        width_px=width_px,
        height_px=height_px,
        fx_px=float(fx_px),
        fy_px=float(fy_px),
        cx_px=float(-left * fx_px),
        cy_px=float(-top * fy_px),
        rotation_cam_from_world=view.rotation_cam_from_world,
        translation_cam_from_world=view.translation_cam_from_world,
        near_world=near_world,
    )
