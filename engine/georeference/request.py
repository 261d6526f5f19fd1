"""What a georeference is to be found from, read and checked before the long work."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.relative_paths import check_relative_path
from octasplat.engine.dataset.image_names import match_image_names
from octasplat.engine.dataset.photograph_files import image_folder, photographs_below
from octasplat.engine.georeference.control_file import CONTROL_FILES, ControlFile, read_control_file

GeoreferenceSource = Literal["auto", "gps", "off"]


@dataclass(frozen=True)
class KnownLength:
    """A distance that is known.

    Attributes:
        ends: names of control points or photographs, numbers of sparse points, or positions ``x,y,z`` in
            the scene.
        metres: between them.
    """

    ends: tuple[str, str]
    metres: float


@dataclass(frozen=True)
class GeoreferenceRequest:
    """What a georeference is to be found from.

    Attributes:
        source: ``auto``: control points, else GPS if it agrees with the scene; ``gps``: GPS; ``off``:
            nothing.
        control: ground control points; None without any.
        length: a known length; None without one.
        unread: further files of control points, of which nobody has named one.
    """

    source: GeoreferenceSource = "auto"
    control: ControlFile | None = None
    length: KnownLength | None = None
    unread: tuple[Path, ...] = ()


def read_request(
    scene: Path, source: GeoreferenceSource, control_points: str | None, known_length: str | None
) -> GeoreferenceRequest:
    """Return what the settings of a run ask for.

    Args:
        scene: folder of the photographs.
        source: where the georeference comes from.
        control_points: the file of the control points, below ``scene``; None takes one that has a known name.
        known_length: two ends and metres, apart by blanks.

    Raises:
        ConfigError: the file or the length cannot be read, or a photograph is not there; the text says
            which.
    """
    if source == "off":
        if control_points or known_length:
            raise ConfigError("`georeference` is off; leave `control_points` and `known_length` out.")
        return GeoreferenceRequest(source)
    control, there = None, list[Path]()
    if control_points is not None:
        try:
            control = read_control_file(scene / check_relative_path(control_points))
        except ValueError as error:
            raise ConfigError(
                f"control_points: {control_points!r} {error}; put the file into {scene} and give its name."
            ) from None
    elif source == "auto":
        there = [scene / name for name in CONTROL_FILES if (scene / name).is_file()]
        control = read_control_file(there[0]) if there else None
    if control is not None:
        _check_photographs(control, scene)
    length = None if known_length is None else parse_length(known_length)
    return GeoreferenceRequest(source, control, length, tuple(there[1:]))


def parse_length(text: str) -> KnownLength:
    """Return the length that ``A B METRES`` says; names with blanks stand in quotes.

    Raises:
        ConfigError: it says none.

    >>> parse_length("'pole top' foot 2.5")
    KnownLength(ends=('pole top', 'foot'), metres=2.5)
    """
    try:
        first, second, length = shlex.split(text)
        metres = float(length)
    except ValueError:
        metres = np.nan
    if not (np.isfinite(metres) and metres > 0) or first == second:
        raise ConfigError(
            f"known_length is {text!r}; write two points and the metres between them: 'A B 2.5', each a "
            "control point, a photograph, or x,y,z."
        )
    return KnownLength((first, second), metres)


def _check_photographs(control: ControlFile, scene: Path) -> None:
    """Refuse control points in photographs that are not there."""
    named = {mark.photograph: mark.line for point in control.points for mark in point.marks}
    found: Mapping[str, str] = match_image_names(named, photographs_below(image_folder(scene)).keys())
    missing = [name for name in named if name not in found]
    if missing:
        others = f" ({len(missing)} such names)" if len(missing) > 1 else ""
        raise ConfigError(
            f"{control.path}, line {named[missing[0]]}: there is no photograph {missing[0]} in "
            f"{image_folder(scene)}{others}; correct the name, or take the line out."
        )
