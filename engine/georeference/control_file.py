"""Files of ground control points: where points that photographs show lie on the ground.

Two forms are read, told apart by their content:

``gcp_list.txt`` of OpenDroneMap: a line with the coordinate system, then for each sighting of a point
``x y z px py photograph name``, apart by blanks or tabs.

A CSV with a line of names: ``name,x,y,z,photograph,px,py``, a row for each sighting; a comment
``# EPSG:32632`` or ``# WGS84 UTM 32N`` says the coordinate system. A row without a photograph is one of a
photograph (its camera's position) or of a sparse point (its number), by ``name``. Points without ``x,y,z``
are for known lengths. Semicolons or tabs may part the columns; numbers may have a decimal comma then.
"""

import csv
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.georeference.coordinate_system import parse_crs, statement_in_comments

CONTROL_FILES = ("gcp_list.txt", "control_points.csv")
"""Names in the folder of a scene that need not be given."""
MAX_BYTES = 10_000_000
_COLUMNS = {"image": "photograph", "im_x": "px", "im_y": "py", "label": "name", "gcp_name": "name"}
_NUMBERS = ("x", "y", "z", "px", "py")
_KNOWN = ("name", "photograph", *_NUMBERS)
_LIKE_A_POSITION = re.compile(
    r"[xyz]\b|[enh]$|east|north|lon|lng|lat|height|alt|elev|rechts|hoch", re.IGNORECASE
)
"""What names of columns begin with that could be those of positions under other names."""
_DELIMITERS = ",;\t"


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
        crs: EPSG code of the positions: that of WGS 84 in degrees (x is the longitude then), or of projected
            ones in metres, x east and y north; None of local metres.
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
    delimiter = _delimiter(content[0][1]) if content else None
    if delimiter is not None:
        stated = statement_in_comments(line.lstrip("# ") for _, line in numbered if line.startswith("#"))
        rows = _csv_rows(path, content, delimiter)
    else:
        stated = content[0][1] if content else ""
        rows = _list_rows(path, content[1:])
    points = _collect_points(path, rows)
    if not points:
        raise ConfigError(f"{path} holds no control points; write a line for each.")
    return ControlFile(path, parse_crs(path, stated), points)


def _delimiter(line: str) -> str | None:
    """Return what parts the columns of a CSV whose line of names this is; None where it is none."""
    for delimiter in _DELIMITERS:
        try:
            names = _csv_names(line, delimiter)
        except csv.Error:
            continue
        if len(names) > 1 and "name" in names:
            return delimiter
    return None


def _csv_names(line: str, delimiter: str) -> list[str]:
    names = (name.strip().lower() for name in next(csv.reader([line], delimiter=delimiter)))
    return [_COLUMNS.get(name, name) for name in names]


def _csv_rows(
    path: Path, content: list[tuple[int, str]], delimiter: str
) -> Iterator[tuple[int, Mapping[str, str]]]:
    names = _csv_names(content[0][1], delimiter)
    _check_names(path, content[0][0], names)
    for number, line in content[1:]:
        try:
            values = [value.strip() for value in next(csv.reader([line], delimiter=delimiter))]
        except csv.Error as error:
            raise ConfigError(f"{path}, line {number}: cannot be read ({error}).") from None
        if len(values) > len(names):
            raise ConfigError(f"{path}, line {number}: has {len(values)} values for {len(names)} columns.")
        row = dict(zip(names, values, strict=False))
        if delimiter != ",":
            row |= {key: row[key].replace(",", ".") for key in _NUMBERS if key in row}
        yield number, row


def _check_names(path: Path, line: int, names: list[str]) -> None:
    """Refuse columns of which it is open what they are."""
    twice = [name for name in _KNOWN if names.count(name) > 1]
    if twice:
        raise ConfigError(f"{path}, line {line}: there are two columns {twice[0]}; leave one.")
    others = [name for name in names if name not in _KNOWN and _LIKE_A_POSITION.match(name)]
    missing = [axis for axis in "xyz" if axis not in names]
    if len(missing) in (1, 2) or (missing and others):
        there = f", but {', '.join(others)}" if others else ""
        raise ConfigError(
            f"{path}, line {line}: there is no column {' and no '.join(missing)}{there}; call the columns of "
            "the position x, y and z (x is the easting or the longitude)."
        )


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
        position, before = _position(path, number, row), positions.get(name)
        if None not in (position, before) and position != before:
            raise ConfigError(f"{path}, line {number}: {name} has another position than before.")
        positions[name] = before if position is None else position
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
