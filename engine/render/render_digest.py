"""Digest of all inputs that decide how a render looks."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from octasplat.engine import __version__
from octasplat.engine.settings.base import Settings, json_by_former_names


def render_digest(*parts: Any) -> str:
    """Return a digest of values: numbers, texts, arrays, models, dataclasses, and lists or mappings of them.

    Paths count by the content of their files and not by their names, so that the same things elsewhere are
    the same; those within a dataclass say where it came from and do not count. The version of octasplat does.
    """
    digest = hashlib.sha256(__version__.encode())
    for part in parts:
        _update_digest(digest, part)
    return digest.hexdigest()


def _update_digest(digest: "hashlib._Hash", value: Any) -> None:
    """Add a value, with its type first and its length last, so that no two values run into each other."""
    digest.update(type(value).__name__.encode() + b"\0")
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str}{value.shape}".encode())
        digest.update(value.tobytes())
    elif isinstance(value, Settings):
        _update_digest(digest, json_by_former_names(value))
    elif isinstance(value, BaseModel):
        _update_digest(digest, value.model_dump_json())
    elif isinstance(value, Path):
        if value.is_file():
            with value.open("rb") as handle:
                digest.update(hashlib.file_digest(handle, "sha256").digest())
    elif is_dataclass(value):
        for field in fields(value):
            if not isinstance(part := getattr(value, field.name), Path):
                _update_digest(digest, field.name)
                _update_digest(digest, part)
    elif isinstance(value, Mapping):
        for key in sorted(value):
            _update_digest(digest, key)
            _update_digest(digest, value[key])
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        for item in value:
            _update_digest(digest, item)
        digest.update(f"{len(value)}".encode())
    else:
        text = repr(value).encode()
        digest.update(f"{len(text)}:".encode() + text)
