"""Comments of text files and PLY that say where a scene lies: its local origin, and its georeference."""

import math
from collections.abc import Mapping
from pathlib import Path

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.georeference import Georeference, georeference_comments, parse_georeference
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin, is_set

ORIGIN_KEY = "origin_world"
"""The comment that gives the origin of large coordinates; :class:`SceneMetadata` calls it so, too."""


def place_comments(origin: Origin, georeference: Georeference | None) -> list[str]:
    """Return the comments of a text or a PLY that say where it has its origin, if that is not 0, and lies."""
    own = [f"{ORIGIN_KEY} {' '.join(repr(float(value)) for value in origin)}"] if is_set(origin) else []
    return own + georeference_comments(georeference)


def parse_place(path: Path, comments: Mapping[str, str]) -> tuple[Origin, Georeference | None]:
    """Return the local origin and the georeference that the comments of a file say, by their first words.

    Raises:
        SceneFileError: they say nonsense.
    """
    try:
        georeference = parse_georeference(comments)
    except ValueError as error:
        reason = str(error).splitlines()[-1].strip()
        raise SceneFileError(f"{path}: its comments of a georeference are damaged ({reason}).") from None
    return _parse_origin(path, comments.get(ORIGIN_KEY)), georeference


def _parse_origin(path: Path, text: str | None) -> Origin:
    if text is None:
        return NO_ORIGIN
    try:
        x, y, z = map(float, text.split())
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise SceneFileError(f"{path}: its comment {ORIGIN_KEY} is {text!r}, which is no point.") from None
    return (x, y, z)
