"""Texts and JSON as Postgres takes them: no NUL, no half of a surrogate pair, no number that is none.

Texts come from files of users, from libraries and from file names, so every value is cleaned where it is
written, once and here; nothing else makes a :class:`psycopg.types.json.Jsonb`.
"""

import math
import re
from typing import Any

from psycopg.types.json import Jsonb

_REFUSED = re.compile("[\0\ud800-\udfff]")
_REPLACEMENT = "\N{REPLACEMENT CHARACTER}"


def storable_text(text: str) -> str:
    """Return the text with a replacement character for each one that Postgres refuses."""
    return _REFUSED.sub(_REPLACEMENT, text)


def storable(value: Any) -> Any:
    """Return a JSON value that Postgres takes: cleaned texts and keys, and null for NaN and infinities."""
    if isinstance(value, str):
        return storable_text(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {storable_text(str(key)): storable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [storable(item) for item in value]
    return value


def as_json(value: Any) -> Jsonb:
    """Return a value for a column of JSON."""
    return Jsonb(storable(value))


def as_json_or_null(value: Any | None) -> Jsonb | None:
    """Return a value for a column of JSON; None is SQL's NULL."""
    return None if value is None else as_json(value)
