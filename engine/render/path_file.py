"""Camera paths as JSON files, to be drawn elsewhere and rendered here; see ``docs/cameras.md``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import ConfigError, OutputError
from octasplat.engine.core.writing import write_json
from octasplat.engine.render.path_document import PathDocument, PathFrame, read_path_document
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.pose_paths import PosePath


@dataclass(frozen=True)
class CameraPath:
    """Cameras to be rendered one after another at ``fps`` frames a second; all of one image size."""

    fps: float
    cameras: tuple[PinholeCamera, ...]


def read_camera_path(path: Path) -> CameraPath:
    """Read a camera path from a JSON file.

    Raises:
        ConfigError: The file is missing or not as described; the message names the field.
    """
    return path_cameras(read_path_document(path), str(path))


def path_cameras(document: PathDocument, name: str = "") -> CameraPath:
    """Return the cameras of a path.

    Args:
        document: what its file says.
        name: of the file, for messages.

    Raises:
        ConfigError: no smooth path leads through the keys.
    """
    given = tuple(_camera(document, frame) for frame in document.frames or document.keys or ())
    try:
        return CameraPath(document.fps, given if document.frames else _between_keys(document, given))
    except ConfigError as error:
        raise ConfigError(f"The camera path {name or 'of the options'} is not valid: {error}") from None


def write_camera_path(path: Path, camera_path: CameraPath) -> None:
    """Write a camera path as a JSON file, atomically.

    Raises:
        ConfigError: The cameras are none, or of several image sizes.
        OutputError: The file cannot be written.
    """
    cameras = camera_path.cameras
    sizes = {(camera.width_px, camera.height_px) for camera in cameras}
    if len(sizes) != 1:
        raise ConfigError("A camera path needs at least one camera and one image size for all of them.")
    ((width, height),) = sizes
    frames = [
        {
            "camera_to_world": camera.world_from_cam.tolist(),
            "fx": camera.fx_px,
            "fy": camera.fy_px,
            "cx": camera.cx_px,
            "cy": camera.cy_px,
        }
        for camera in cameras
    ]
    try:
        write_json(path, {"width": width, "height": height, "fps": camera_path.fps, "frames": frames})
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}.") from error


def _camera(content: PathDocument, frame: PathFrame) -> PinholeCamera:
    pose = np.array(frame.camera_to_world, dtype=np.float64)
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right  # Rounded digits in the file leave it not quite a rotation.
    if frame.fov_y_degrees is not None:
        fx = fy = focal_from_fov(frame.fov_y_degrees, content.height)
    else:
        fx, fy = frame.fx, frame.fy  # type: ignore[assignment]
    return PinholeCamera.from_pose(
        pose, content.width, content.height, fx_px=fx, fy_px=fy, cx_px=frame.cx, cy_px=frame.cy
    )


def _between_keys(content: PathDocument, keys: tuple[PinholeCamera, ...]) -> tuple[PinholeCamera, ...]:
    """Cameras in equal steps of time along a smooth path through the keys, as are their lenses."""
    assert content.seconds is not None
    path = PosePath(np.stack([key.world_from_cam for key in keys]), content.closed)
    frames = max(2, round(content.seconds * content.fps))
    times = np.linspace(0.0, 1.0, frames, endpoint=not content.closed)
    if content.ease == "in-out":
        times = times * times * (3.0 - 2.0 * times)
    lenses = np.array([[key.fx_px, key.fy_px, key.cx_px, key.cy_px] for key in keys])
    if content.closed:
        lenses = np.concatenate([lenses, lenses[:1]])
    between = np.stack([np.interp(times, path.key_times, lens) for lens in lenses.T], axis=1)
    return tuple(
        PinholeCamera.from_pose(pose, content.width, content.height, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy)
        for pose, (fx, fy, cx, cy) in zip(path.poses_at(times), between.tolist(), strict=True)
    )


def path_from_poses(poses: Sequence[np.ndarray], like: PinholeCamera, fps: float = 30.0) -> CameraPath:
    """A path of cameras at the given poses, with the size and optics of one camera."""
    cameras = tuple(
        PinholeCamera.from_pose(
            np.asarray(pose, dtype=np.float64), like.width_px, like.height_px,
            fx_px=like.fx_px, fy_px=like.fy_px, cx_px=like.cx_px, cy_px=like.cy_px,
        )
        for pose in poses
    )  # fmt: skip
    return CameraPath(fps, cameras)
