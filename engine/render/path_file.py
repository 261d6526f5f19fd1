"""Camera paths as JSON files, to be drawn elsewhere and rendered here; see ``docs/cameras.md``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from octasplat.engine.errors import ConfigError, OutputError
from octasplat.engine.render.cameras import RenderCamera, focal_from_fov
from octasplat.engine.render.paths import PosePath
from octasplat.engine.writing import write_json

MAX_FRAMES = 100_000
_RIGID_TOLERANCE = 1e-3

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Row = tuple[_Finite, _Finite, _Finite, _Finite]


@dataclass(frozen=True)
class CameraPath:
    """Cameras to be rendered one after another at ``fps`` frames a second; all of one image size."""

    fps: float
    cameras: tuple[RenderCamera, ...]


class _Frame(BaseModel):
    model_config = ConfigDict(extra="forbid")
    camera_to_world: tuple[_Row, _Row, _Row, _Row]
    fov_y_degrees: Annotated[float, Field(gt=0, lt=180)] | None = None
    fx: _Positive | None = None
    fy: _Positive | None = None
    cx: _Finite | None = None
    cy: _Finite | None = None

    @model_validator(mode="after")
    def _check(self) -> "_Frame":
        if (self.fov_y_degrees is None) == (self.fy is None) or (self.fx is None) != (self.fy is None):
            raise ValueError("needs either fov_y_degrees or both fx and fy")
        pose = np.array(self.camera_to_world)
        rotation = pose[:3, :3]
        rigid = np.allclose(rotation.T @ rotation, np.eye(3), atol=_RIGID_TOLERANCE)
        if not rigid or np.linalg.det(rotation) < 0 or not np.allclose(pose[3], [0, 0, 0, 1]):
            raise ValueError(
                "camera_to_world must be a rotation without scale or mirroring, a position, "
                "and a last row of 0 0 0 1"
            )
        return self


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")
    width: Annotated[int, Field(gt=0, le=16384)]
    height: Annotated[int, Field(gt=0, le=16384)]
    fps: _Positive = 30.0
    frames: Annotated[list[_Frame] | None, Field(min_length=1)] = None
    keys: Annotated[list[_Frame] | None, Field(min_length=2)] = None
    seconds: _Positive | None = None
    closed: bool = False
    ease: Literal["none", "in-out"] = "none"

    @model_validator(mode="after")
    def _one_of_both(self) -> "_File":
        if (self.frames is None) == (self.keys is None):
            raise ValueError("needs either frames or keys")
        if (self.keys is None) != (self.seconds is None):
            raise ValueError("keys need seconds, and frames have none")
        if self.frames is not None and (self.closed or self.ease != "none"):
            raise ValueError("closed and ease go with keys")
        if self.closed and self.ease != "none":
            raise ValueError(
                "a closed path goes on where it began, so it cannot slow down there; leave out ease"
            )
        if self.seconds is not None and self.seconds * self.fps > MAX_FRAMES:
            raise ValueError(f"seconds and fps make more than {MAX_FRAMES:,} frames")
        return self


def read_camera_path(path: Path) -> CameraPath:
    """Read a camera path from a JSON file.

    Raises:
        ConfigError: The file is missing or not as described; the message names the field.
    """
    try:
        content = _File.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"Cannot read the camera path {path}: {error.strerror or error}.") from error
    except ValidationError as error:
        raise ConfigError(
            f"The camera path {path} is not valid: {_first(error)} (docs/cameras.md tells the format)."
        ) from error
    given = tuple(_camera(content, frame) for frame in content.frames or content.keys or ())
    try:
        return CameraPath(content.fps, given if content.frames else _between_keys(content, given))
    except ConfigError as error:
        raise ConfigError(f"The camera path {path} is not valid: {error}") from None


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


def _camera(content: _File, frame: _Frame) -> RenderCamera:
    pose = np.array(frame.camera_to_world, dtype=np.float64)
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right  # Rounded digits in the file leave it not quite a rotation.
    if frame.fov_y_degrees is not None:
        fx = fy = focal_from_fov(frame.fov_y_degrees, content.height)
    else:
        fx, fy = frame.fx, frame.fy  # type: ignore[assignment]
    return RenderCamera.from_pose(
        pose, content.width, content.height, fx_px=fx, fy_px=fy, cx_px=frame.cx, cy_px=frame.cy
    )


def _between_keys(content: _File, keys: tuple[RenderCamera, ...]) -> tuple[RenderCamera, ...]:
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
        RenderCamera.from_pose(pose, content.width, content.height, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy)
        for pose, (fx, fy, cx, cy) in zip(path.at(times), between.tolist(), strict=True)
    )


def _first(error: ValidationError) -> str:
    """The first fault, as ``frames[3].fx: Input should be ...``."""
    details = error.errors()[0]
    place = ""
    for part in details["loc"]:
        place += f"[{part}]" if isinstance(part, int) else f".{part}" if place else str(part)
    message = details["msg"].removeprefix("Value error, ").rstrip(".")
    return f"{place}: {message}" if place else message


def path_from_poses(poses: Sequence[np.ndarray], like: RenderCamera, fps: float = 30.0) -> CameraPath:
    """A path of cameras at the given poses, with the size and optics of one camera."""
    cameras = tuple(
        RenderCamera.from_pose(
            np.asarray(pose, dtype=np.float64), like.width_px, like.height_px,
            fx_px=like.fx_px, fy_px=like.fy_px, cx_px=like.cx_px, cy_px=like.cy_px,
        )
        for pose in poses
    )  # fmt: skip
    return CameraPath(fps, cameras)
