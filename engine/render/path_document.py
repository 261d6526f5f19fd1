"""Camera path files, parsed and validated; see ``docs/cameras.md``. Imports no numpy, as clients use it."""

import json
import math
import operator
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from octasplat.engine.core.errors import ConfigError

MAX_FRAMES = 100_000
_RIGID_TOLERANCE = 1e-3
"""Files have rounded numbers."""
_LAST_ROW = (0.0, 0.0, 0.0, 1.0)

_Finite = Annotated[float, Field(allow_inf_nan=False)]
_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Row = tuple[_Finite, _Finite, _Finite, _Finite]


class PathFrame(BaseModel):
    """One camera of a path: its pose, and its lens by field of view or in pixels."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    camera_to_world: tuple[_Row, _Row, _Row, _Row]
    fov_y_degrees: Annotated[float, Field(gt=0, lt=180)] | None = None
    fx: _Positive | None = None
    fy: _Positive | None = None
    cx: _Finite | None = None
    cy: _Finite | None = None

    @model_validator(mode="after")
    def _check(self) -> "PathFrame":
        if (self.fov_y_degrees is None) == (self.fy is None) or (self.fx is None) != (self.fy is None):
            raise ValueError("needs either fov_y_degrees or both fx and fy")
        if not _is_pose(self.camera_to_world):
            raise ValueError(
                "camera_to_world must be a rotation without scale or mirroring, a position, "
                "and a last row of 0 0 0 1"
            )
        return self


def _is_pose(matrix: tuple[_Row, _Row, _Row, _Row]) -> bool:
    """Return whether a matrix is a rigid pose with the last row 0 0 0 1; without numpy, for clients."""
    x, y, z = ([row[k] for row in matrix[:3]] for k in range(3))
    across = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]
    axes = (x, y, z)
    is_rigid = all(
        math.isclose(sum(map(operator.mul, axes[i], axes[j])), float(i == j), abs_tol=_RIGID_TOLERANCE)
        for i in range(3)
        for j in range(3)
    )
    is_right_handed = sum(map(operator.mul, across, z)) > 0
    ends = all(
        math.isclose(a, b, rel_tol=1e-5, abs_tol=1e-8) for a, b in zip(matrix[3], _LAST_ROW, strict=True)
    )
    return is_rigid and is_right_handed and ends


class PathDocument(BaseModel):
    """The content of a camera path file: all cameras, or key cameras to interpolate.

    Attributes:
        width: of all images, px.
        height: of all images, px.
        fps: images per second.
        frames: the cameras, in the order in which they are rendered.
        keys: cameras that the path passes in equal steps of time, instead of ``frames``.
        seconds: how long the path through the keys takes.
        closed: whether the path goes back from the last key to the first.
        ease: ``in-out`` starts and ends slowly.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    width: Annotated[int, Field(gt=0, le=16384)]
    height: Annotated[int, Field(gt=0, le=16384)]
    fps: _Positive = 30.0
    frames: Annotated[tuple[PathFrame, ...] | None, Field(min_length=1, max_length=MAX_FRAMES)] = None
    keys: Annotated[tuple[PathFrame, ...] | None, Field(min_length=2, max_length=MAX_FRAMES)] = None
    seconds: _Positive | None = None
    closed: bool = False
    ease: Literal["none", "in-out"] = "none"

    @model_validator(mode="after")
    def _one_of_both(self) -> "PathDocument":
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

    @property
    def frame_count(self) -> int:
        """Return the number of images."""
        if self.frames is not None:
            return len(self.frames)
        assert self.seconds is not None
        return max(2, round(self.seconds * self.fps))  # both ends, even of a very short path


def read_path_document(path: Path) -> PathDocument:
    """Read and validate a camera path file.

    Raises:
        ConfigError: the file is missing or not as described; the message names the field.
    """
    try:
        return PathDocument.model_validate_json(path.read_bytes())
    except OSError as error:
        raise ConfigError(f"Cannot read the camera path {path}: {error.strerror or error}.") from error
    except ValidationError as error:
        raise ConfigError(
            f"The camera path {path} is not valid: {_first_error(error)} (docs/cameras.md tells the format)."
        ) from error


def parse_path_text(value: object) -> object:
    """Return the content of a JSON text; any other value as it is."""
    if not isinstance(value, str):
        return value
    try:
        return json.loads(value)  # deeply nested text exhausts the parser's stack
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the camera path is no JSON: {error}") from None


def _first_error(error: ValidationError) -> str:
    """Return the first error, as ``frames[3].fx: Input should be ...``."""
    details = error.errors()[0]
    place = ""
    for part in details["loc"]:
        place += f"[{part}]" if isinstance(part, int) else f".{part}" if place else str(part)
    message = details["msg"].removeprefix("Value error, ").rstrip(".")
    return f"{place}: {message}" if place else message
