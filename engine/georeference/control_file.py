"""Files of ground control points: where points that photographs show lie on the ground.

Two forms are read, told apart by their content:

``gcp_list.txt`` of OpenDroneMap: a line with the coordinate system, then for each sighting of a point
``x y z px py photograph name``, apart by blanks or tabs.

A CSV with a line of names: ``name,x,y,z,photograph,px,py``, a row for each sighting; a comment
``# EPSG:32632`` or ``# WGS84 UTM 32N`` says the coordinate system. A row without a photograph is one of a
photograph (its camera's position) or of a sparse point (its number), by ``name``. Points without ``x,y,z``
are for known lengths.
"""

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.georeference import WGS84

CONTROL_FILES = ("gcp_list.txt", "control_points.csv")
"""Names in the folder of a scene that need not be given."""
MAX_BYTES = 10_000_000
_COLUMNS = {"image": "photograph", "im_x": "px", "im_y": "py", "label": "name", "gcp_name": "name"}
_PROJECTED_AMONG_DEGREES = frozenset((*range(4491, 4555), 4647))
"""EPSG codes of projected systems in metres, of CGCS2000 and of Germany, among those that give degrees."""
_MERCATOR = frozenset((3395, 3785, 3857, 54004, 102100, 102113, 900913))
"""EPSG codes, and others used as such, of the whole Earth on one map, with metres at the equator alone."""
_FEET = frozenset((*range(2222, 2290), *range(3433, 3439)))
"""EPSG codes of state planes of the USA (NAD83) in feet; those of later datums are not told from metres."""
_EPSG = re.compile(r"EPSG", re.IGNORECASE)
_LOCAL = re.compile(r"^local$", re.IGNORECASE)
_OTHER_SYSTEM = re.compile(r"\bUTM\b|\+proj|\bWGS ?84\b", re.IGNORECASE)
"""What a comment has that says a coordinate system, known or not."""
_UTM = re.compile(r"WGS ?84 UTM ?(?:zone )?([0-9]{1,2}) ?([NS])", re.IGNORECASE)
_PROJ_UTM = re.compile(r"\+proj=utm .*\+zone=([0-9]{1,2})", re.IGNORECASE)


@dataclass(frozen=True)
class Mark:
    """A control point as a photograph shows it.

    Attributes:
        photograph: its name.
        x_px: from the left edge of the photograph as stored, at its full size.
        y_px: from its upper edge.
        line: of the file.
    """

    photograph: str
    x_px: float
    y_px: float
    line: int


@dataclass(frozen=True)
class ControlPoint:
    """A point whose position on the ground is known, or whose name stands for a point of the scene.

    Attributes:
        name: of the point; without marks, of a photograph or a sparse point.
        position: in the coordinates of the file; None where it is not known.
        marks: where photographs show it.
    """

    name: str
    position: tuple[float, float, float] | None
    marks: tuple[Mark, ...]


@dataclass(frozen=True)
class ControlFile:
    """The content of a file of control points.

    Attributes:
        path: of the file.
        crs: EPSG code of the positions: :data:`WGS84` (x is the longitude then), or of projected ones in
            metres, x east and y north; None of local metres.
        points: in the order of the file.
    """

    path: Path
    crs: str | None
    points: tuple[ControlPoint, ...]


def read_control_file(path: Path) -> ControlFile:
    """Read control points.

    Raises:
        ConfigError: the file cannot be read, or a line of it says nonsense; the text names both.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(f"{path} has more than {MAX_BYTES / 1e6:.0f} MB; control points take less.")
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(
            f"{path} cannot be read as text ({reason}); name a file of control points."
        ) from None
    numbered = [(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip()]
    content = [(number, line) for number, line in numbered if not line.startswith("#")]
    is_csv = bool(content) and "," in content[0][1] and "name" in _csv_names(content[0][1])
    if is_csv:
        comments = [line.lstrip("# ") for _, line in numbered if line.startswith("#")]
        # a number comes first, then a plain "local"; any other system is read or refused, so that its points
        # are not taken as local
        patterns = (_EPSG, _LOCAL, _OTHER_SYSTEM)
        found = [line for pattern in patterns for line in comments if pattern.search(line)]
        stated = next(iter(found), "")
        rows = _csv_rows(path, content)
    else:
        stated = content[0][1] if content else ""
        rows = _list_rows(path, content[1:])
    points = _collect_points(path, rows)
    if not points:
        raise ConfigError(f"{path} holds no control points; write a line for each.")
    return ControlFile(path, _parse_crs(path, stated), points)


def _csv_names(line: str) -> list[str]:
    names = (name.strip().lower() for name in line.split(","))
    return [_COLUMNS.get(name, name) for name in names]


def _csv_rows(path: Path, content: list[tuple[int, str]]) -> Iterator[tuple[int, Mapping[str, str]]]:
    names = _csv_names(content[0][1])
    for number, line in content[1:]:
        try:
            values = [value.strip() for value in next(csv.reader([line]))]
        except csv.Error as error:
            raise ConfigError(f"{path}, line {number}: cannot be read ({error}).") from None
        if len(values) > len(names):
            raise ConfigError(f"{path}, line {number}: has {len(values)} values for {len(names)} columns.")
        yield number, dict(zip(names, values, strict=False))


def _list_rows(path: Path, content: list[tuple[int, str]]) -> Iterator[tuple[int, Mapping[str, str]]]:
    for number, line in content:
        values = line.split()
        if len(values) < 6:
            raise ConfigError(
                f"{path}, line {number}: has {len(values)} values; write x y z px py photograph name."
            )
        # sightings without a name are of one point where their positions are the same
        name = values[6] if len(values) > 6 else " ".join(values[:3])
        yield (
            number,
            dict(zip(("x", "y", "z", "px", "py", "photograph"), values, strict=False)) | {"name": name},
        )


def _collect_points(path: Path, rows: Iterator[tuple[int, Mapping[str, str]]]) -> tuple[ControlPoint, ...]:
    positions: dict[str, tuple[float, float, float] | None] = {}
    marks: dict[str, list[Mark]] = {}
    for number, row in rows:
        name = row.get("name", "")
        if not name:
            raise ConfigError(f"{path}, line {number}: the point has no name.")
        position = _position(path, number, row)
        if positions.setdefault(name, position) != position:
            raise ConfigError(f"{path}, line {number}: {name} has another position than before.")
        marks.setdefault(name, [])
        if row.get("photograph"):
            x, y = (_number(path, number, row, axis) for axis in ("px", "py"))
            marks[name].append(Mark(row["photograph"], x, y, number))
    return tuple(ControlPoint(name, positions[name], tuple(marks[name])) for name in positions)


def _position(path: Path, line: int, row: Mapping[str, str]) -> tuple[float, float, float] | None:
    if not any(row.get(axis) for axis in "xyz"):
        return None
    x, y, z = (_number(path, line, row, axis) for axis in "xyz")
    return x, y, z


def _number(path: Path, line: int, row: Mapping[str, str], name: str) -> float:
    try:
        value = float(row.get(name, ""))
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise ConfigError(f"{path}, line {line}: {name} is {row.get(name, '')!r}, which is no number.")
    return value


def _parse_crs(path: Path, text: str) -> str | None:
    """Return the EPSG code that a line states; None of local metres.

    Raises:
        ConfigError: another coordinate system than these are read in.
    """
    if found := re.search(r"EPSG:+([0-9]{4,6})", text, re.IGNORECASE):
        code = int(found.group(1))
        if code in (4326, 4979):
            return WGS84
        if 4000 <= code < 5000 and code not in _PROJECTED_AMONG_DEGREES:
            raise ConfigError(
                f"{path}: EPSG:{code} gives no metres east and north; write the points in EPSG:4326 or in a "
                "projected system, such as UTM."
            )
        if code in _MERCATOR:
            raise ConfigError(
                f"{path}: lengths in EPSG:{code}, a map of the whole Earth, grow with the latitude, so "
                "that they are no metres; write the points in EPSG:4326 or in UTM."
            )
        if code in _FEET:
            raise ConfigError(
                f"{path}: EPSG:{code} is in feet; write the points in EPSG:4326, in UTM or in the same "
                "system in metres."
            )
        return f"EPSG:{code}"
    utm, is_south = _UTM.search(text), "+south" in text
    if utm is not None:
        is_south = utm.group(2).upper() == "S"
    else:
        utm = _PROJ_UTM.search(text)
    if utm is not None and 1 <= int(utm.group(1)) <= 60:
        return f"EPSG:{32600 + 100 * is_south + int(utm.group(1))}"
    if "+proj=longlat" in text or text.strip().upper() in ("WGS84", "WGS 84"):
        return WGS84
    if text.strip().lower() in ("", "local"):
        return None
    raise ConfigError(
        f"{path}: the coordinate system {text[:60]!r} is not known; write EPSG: and its number, or local."
    )
