"""Camera paths that tests write, for octasplat and for other programs to read."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from octasplat.engine.render.path_file import CameraPath
from octasplat.engine.render.pinhole_camera import PinholeCamera


def write_camera_path(path: Path, camera_path: CameraPath) -> None:
    """Write a camera path as a JSON file; all cameras have one image size."""
    ((width, height),) = {(camera.width_px, camera.height_px) for camera in camera_path.cameras}
    frames = [
        {
            "camera_to_world": camera.world_from_cam.tolist(),
            "fx": camera.fx_px,
            "fy": camera.fy_px,
            "cx": camera.cx_px,
            "cy": camera.cy_px,
        }
        for camera in camera_path.cameras
    ]
    content = {"width": width, "height": height, "fps": camera_path.fps, "frames": frames}
    path.write_text(json.dumps(content), encoding="utf-8")


def path_from_poses(poses: Sequence[np.ndarray], like: PinholeCamera, fps: float = 30.0) -> CameraPath:
    """Return a path of cameras at the given poses, with the size and optics of one camera."""
    cameras = tuple(
        PinholeCamera.from_pose(
            np.asarray(pose, dtype=np.float64), like.width_px, like.height_px,
            fx_px=like.fx_px, fy_px=like.fy_px, cx_px=like.cx_px, cy_px=like.cy_px,
        )
        for pose in poses
    )  # fmt: skip
    return CameraPath(fps, cameras)
