"""COLMAP's text files, line by line: what its own reader misreads or stops at is read, or refused by line.

That reader cuts names at spaces, takes every second pose for observations where there are none, and names
the check of its code that failed, which helps nobody to find the line.
"""

import codecs
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset.colmap_records import (
    NO_POINT,
    CameraRecord,
    ImageRecord,
    ModelRecords,
    PointRecord,
)

_POSE_FIELDS = 9
"""Fields of the line of an image before its name."""
_MARKS = {
    codecs.BOM_UTF8: ("utf-8-sig", "begins with a byte order mark"),
    codecs.BOM_UTF16_LE: ("utf-16", "is UTF-16"),
    codecs.BOM_UTF16_BE: ("utf-16", "is UTF-16"),
}

_Line = tuple[int, str]


def is_plain_text_model(folder: Path) -> bool:
    """Return whether COLMAP's own reader takes a text model as it is meant, as far as is told.

    Encodings, names without spaces, and the line of observations after each image are looked at.
    """
    for part in ("cameras", "images", "points3D"):
        path = folder / f"{part}.txt"
        if path.is_file():
            with path.open("rb") as file:
                head = file.read(4)
            if head.startswith(tuple(_MARKS)) or b"\0" in head:
                return False
    if not (folder / "images.txt").is_file():
        return True
    with (folder / "images.txt").open("rb") as lines:
        for line in lines:
            if not line.strip() or line.startswith(b"#"):
                continue
            observed = next(lines, None)
            if len(line.split()) != _POSE_FIELDS + 1 or observed is None:
                return False
            # Four observations tell them from a pose with spaces in its name.
            fields = observed.split(maxsplit=12)[:12]
            if len(fields) % 3 or _find_invalid_number(fields) or not all(map(_is_integer, fields[2::3])):
                return False
    return True


def read_text_model(folder: Path) -> ModelRecords:
    """Read a text model with care for what programs and people make of one.

    Raises:
        DatasetError: a line cannot be read; the sentence names the file, the line and what is wrong.
    """
    repairs: list[str] = []
    lines = {part: _read_lines(folder / f"{part}.txt", repairs) for part in ("cameras", "images", "points3D")}
    cameras = _read_cameras(folder / "cameras.txt", lines["cameras"], repairs)
    images = _read_images(folder / "images.txt", lines["images"], repairs)
    _check_frames(folder / "frames.txt", images)
    for image in images.values():
        if image.camera_id not in cameras:
            raise DatasetError(
                f"{folder / 'images.txt'} names camera {image.camera_id} for {image.name}, which is not in "
                "cameras.txt; copy both files from one model."
            )
    points = _read_points(folder / "points3D.txt", lines["points3D"], repairs)
    if any((folder / f"{part}.txt").is_file() for part in ("rigs", "frames")):
        repairs.append(f"Rigs of the model in {folder} are not used; the poses in images.txt are taken.")
    return ModelRecords(cameras, images, points, tuple(repairs))


def _read_lines(path: Path, repairs: list[str]) -> list[_Line]:
    """Return the lines of a file with their numbers, comments left out."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"{path} cannot be read ({error.strerror}).") from error
    encoding, what = next((known for mark, known in _MARKS.items() if data.startswith(mark)), ("utf-8", ""))
    # UTF-16 without a mark: every second byte of ASCII text is NUL.
    if not what and b"\0" in data[:4]:
        encoding, what = ("utf-16-le" if data[1:2] == b"\0" else "utf-16-be"), "is UTF-16"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise DatasetError(f"{path} is neither UTF-8 nor UTF-16 (line {line}); save it as UTF-8.") from None
    if what:
        repairs.append(f"{path} {what}, and is read so.")
    # Not splitlines(), which also breaks at characters that names may hold, such as U+2028
    numbered = enumerate(text.removesuffix("\n").split("\n"), start=1)
    # Empty lines stay: after an image they say that it shows no points.
    return [(number, line.strip()) for number, line in numbered if not line.lstrip().startswith("#")]


def _records(path: Path, lines: Sequence[_Line], what: str) -> Iterator[tuple[int, str, list[str]]]:
    """Yield the lines with values, with their numbers and their values; refuse numbers that are none."""
    for number, line in lines:
        if parts := line.split():
            _check_numbers(path, number, what, parts, {})
            yield number, line, parts


def _read_cameras(path: Path, lines: Sequence[_Line], repairs: list[str]) -> dict[int, CameraRecord]:
    cameras: dict[int, CameraRecord] = {}
    known = _KnownIds(path, "camera", repairs)
    for number, line, parts in _records(path, lines, "cameras"):
        if len(parts) < 4 or not all(_is_integer(part) for part in (parts[0], *parts[2:4])):
            raise _line_error(path, number, "holds no camera (CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS)")
        models = pycolmap.CameraModelId.__members__.keys() - {"INVALID"}
        if parts[1] not in models:
            raise _line_error(path, number, f"names the camera model {parts[1][:30]}, which COLMAP has not")
        needed = len(pycolmap.Camera.create_from_model_name(0, parts[1], 1.0, 1, 1).params)
        if len(parts) - 4 != needed:
            raise _line_error(
                path,
                number,
                f"has {len(parts) - 4} parameters for camera {parts[0]}, and {parts[1]} needs {needed}",
            )
        if known.is_new(int(parts[0]), number, line):
            sizes, params = [int(part) for part in parts[2:4]], tuple(map(float, parts[4:]))
            cameras[int(parts[0])] = CameraRecord(int(parts[0]), parts[1], sizes[0], sizes[1], params)
    known.tell()
    return cameras


def _read_images(path: Path, lines: Sequence[_Line], repairs: list[str]) -> dict[int, ImageRecord]:
    images: dict[int, ImageRecord] = {}
    known = _KnownIds(path, "image", repairs)
    names: dict[str, str] = {}
    for _, line in lines:
        if _is_pose(line):
            names[line.split()[0]] = _name_in(line)
    without = position = 0
    while position < len(lines):
        number, line = lines[position]
        position += 1
        if not line:
            continue
        parts = line.split()
        _check_numbers(path, number, "images", parts, names)
        if not _is_pose(line):
            raise _line_error(
                path, number, "holds no image (IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME)"
            )
        observed: list[str] = []
        if position < len(lines) and not _is_pose(lines[position][1]):
            observed = lines[position][1].split()
            _check_observations(path, lines[position][0], observed)
            position += 1
        else:
            without += 1
        if known.is_new(int(parts[0]), number, line):
            values = np.array(observed, dtype=np.float64).reshape(-1, 3)
            numbers = tuple(map(float, parts[1:8]))
            images[int(parts[0])] = ImageRecord(
                image_id=int(parts[0]),
                quaternion_wxyz=numbers[:4],
                translation=numbers[4:],
                camera_id=int(parts[8]),
                name=_name_in(line),
                observed_px=values[:, :2],
                observed_point_ids=np.array([_point_id(text) for text in observed[2::3]], np.int64),
            )
    known.tell()
    if without:
        repairs.append(
            f"{path} has no line of observations after {without} of {len(images)} images; their poses are "
            "taken."
        )
    return images


def _read_points(path: Path, lines: Sequence[_Line], repairs: list[str]) -> dict[int, PointRecord]:
    points: dict[int, PointRecord] = {}
    known = _KnownIds(path, "point", repairs)
    for number, line, parts in _records(path, lines, "points3D"):
        form = "holds no point (POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK)"
        try:
            point_id, rgb = int(parts[0]), [int(float(part)) for part in parts[4:7]]
            error = float(parts[7]) if len(parts) > 7 else -1.0  # -1: COLMAP's mark for an unknown error
            track = [int(part) for part in parts[8:]]
        except (ValueError, OverflowError):
            raise _line_error(path, number, form) from None
        if len(rgb) != 3 or not all(0 <= value <= 255 for value in rgb) or len(track) % 2 or point_id < 0:
            raise _line_error(path, number, form)
        if known.is_new(point_id, number, line):
            pairs = tuple(zip(track[::2], track[1::2], strict=True))
            points[point_id] = PointRecord(point_id, tuple(map(float, parts[1:4])), tuple(rgb), error, pairs)
    known.tell()
    return points


class _KnownIds:
    """Ids that came so far, with their lines: one that comes again is taken once if it says the same."""

    def __init__(self, path: Path, what: str, repairs: list[str]) -> None:
        self._path, self._what, self._repairs = path, what, repairs
        self._lines: dict[int, _Line] = {}
        self._repeated: list[int] = []

    def is_new(self, number_of: int, number: int, line: str) -> bool:
        """Return whether the id is new; refuse one that came with other values."""
        before = self._lines.setdefault(number_of, (number, line))
        if before[0] == number:
            return True
        if before[1] != line:
            raise DatasetError(
                f"{self._path} has {self._what} {number_of} twice (lines {before[0]} and {number}) with "
                "other values; remove one of the lines."
            )
        self._repeated.append(number_of)
        return False

    def tell(self) -> None:
        """Note the ids that came again."""
        if self._repeated:
            shown = ", ".join(map(str, self._repeated[:3])) + (", ..." if len(self._repeated) > 3 else "")
            self._repairs.append(
                f"{self._path} has {len(self._repeated)} lines twice ({self._what} {shown}); each "
                "counts once."
            )


def _check_frames(path: Path, images: dict[int, ImageRecord]) -> None:
    if not path.is_file():
        return
    names = {str(number): image.name for number, image in images.items()}
    for number, line in _read_lines(path, []):
        if line:
            _check_numbers(path, number, "frames", line.split(), names)


_NUMERIC_FIELDS = {
    "cameras": slice(4, None),
    "frames": slice(2, 9),
    "images": slice(1, 8),
    "points3D": slice(1, 4),
}
"""Where a line holds the numbers that must be finite."""


def _check_numbers(path: Path, number: int, part: str, parts: list[str], names: dict[str, str]) -> None:
    fault = _find_invalid_number(parts[_NUMERIC_FIELDS[part]])
    if fault is not None:
        whose, remedy = _describe_line(part, parts, names)
        raise DatasetError(f"{path} holds {fault} in {whose} (line {number}); {remedy}.")


def _check_observations(path: Path, number: int, fields: Sequence[str]) -> None:
    fault = _find_invalid_number(fields)
    if fault is not None:
        raise DatasetError(
            f"{path} holds {fault} in the observations of an image (line {number}); mend the line or leave "
            "it empty."
        )
    if len(fields) % 3 or not all(map(_is_integer, fields[2::3])):
        raise _line_error(path, number, "holds neither an image nor observations (X, Y, POINT3D_ID, ...)")


def _line_error(path: Path, number: int, fault: str) -> DatasetError:
    return DatasetError(f"{path} {fault} (line {number}); mend the line or run COLMAP again.")


def _is_pose(line: str) -> bool:
    """Return whether a line describes an image rather than observations.

    Longer lines of nothing but numbers are observations.
    """
    fields = line.split(maxsplit=_POSE_FIELDS)
    if len(fields) <= _POSE_FIELDS or not _is_integer(fields[0]) or not _is_integer(fields[8]):
        return False
    everything = line.split()
    return len(everything) == _POSE_FIELDS + 1 or _find_invalid_number(everything) is not None


def _name_in(line: str) -> str:
    return line.split(maxsplit=_POSE_FIELDS)[_POSE_FIELDS]


def _point_id(text: str) -> int:
    """Return the number of a point; COLMAP's mark for none is -1, or the largest number of 64 bits."""
    value = int(text)
    return value if 0 <= value < 2**63 else NO_POINT


def _is_integer(text: str | bytes) -> bool:
    try:
        int(text)
    except ValueError:
        return False
    return True


def _find_invalid_number(texts: Sequence[str | bytes]) -> str | None:
    for text in texts:
        try:
            if math.isfinite(float(text)):
                continue
        except ValueError:
            pass
        return f"{text[:20]!r} where a finite number belongs"
    return None


def _describe_line(part: str, parts: list[str], names: dict[str, str]) -> tuple[str, str]:
    """Return what a line describes, and what the user can do about it."""
    if part == "cameras":
        return f"camera {parts[0]}", "mend the line or run COLMAP again"
    if part == "points3D":
        return f"point {parts[0]}", "remove the line or run COLMAP again"
    ids = parts[0:1] if part == "images" else parts[12::3]
    whose = " and ".join(names.get(each, f"image {each}") for each in ids) or f"frame {parts[0]}"
    return f"the pose of {whose}", "run COLMAP again or remove the image"
