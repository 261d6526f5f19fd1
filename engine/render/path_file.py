"""Camera paths from JSON files; see ``docs/cameras.md``."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.render.path_document import PathDocument, PathFrame, read_path_document
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.pose_paths import PosePath


@dataclass(frozen=True)
class CameraPath:
    """Cameras to be rendered in sequence at ``fps`` frames per second; all of one image size."""

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
    given = tuple(_camera_of_frame(document, frame) for frame in document.frames or document.keys or ())
    try:
        return CameraPath(document.fps, given if document.frames else _between_keys(document, given))
    except ConfigError as error:
        raise ConfigError(f"The camera path {name or 'of the options'} is not valid: {error}") from None


def _camera_of_frame(content: PathDocument, frame: PathFrame) -> PinholeCamera:
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
    """Return cameras in equal time steps along a smooth path through the keys, lenses interpolated."""
    assert content.seconds is not None
    path = PosePath(np.stack([key.world_from_cam for key in keys]), content.closed)
    frames = max(2, round(content.seconds * content.fps))
    times = np.linspace(0.0, 1.0, frames, endpoint=not content.closed)
    if content.ease == "in-out":
        times = times * times * (3.0 - 2.0 * times)  # smoothstep: no speed at both ends
    lenses = np.array([[key.fx_px, key.fy_px, key.cx_px, key.cy_px] for key in keys])
    if content.closed:
        lenses = np.concatenate([lenses, lenses[:1]])  # back to the first lens
    between = np.stack([np.interp(times, path.key_times, lens) for lens in lenses.T], axis=1)
    return tuple(
        PinholeCamera.from_pose(pose, content.width, content.height, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy)
        for pose, (fx, fy, cx, cy) in zip(path.poses_at(times), between.tolist(), strict=True)
    )
