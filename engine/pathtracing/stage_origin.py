"""Stages of scenes whose coordinates are large: places given in them are moved about the scene's origin.

Gaussians, meshes and rays are about the local origin of a scene (:mod:`octasplat.engine.core.local_origin`).
Stages that octasplat writes are so as well; a user may also give places as a map has them, which are so far
from the local origin that each place by itself shows which it is.
"""

from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel

from octasplat.engine.core.local_origin import Origin, describe_origin, is_set
from octasplat.engine.pathtracing.stage.model import Stage

PlacedT = TypeVar("PlacedT", bound=BaseModel)


def stage_about(stage: Stage, origin: Origin) -> tuple[Stage, tuple[str, ...]]:
    """Return a stage with its places about a scene's local origin, and the keys of those that were moved."""
    if not is_set(origin):
        return stage, ()
    moved: list[str] = []
    parts: dict[str, Any] = {
        name: tuple(
            _placed_about(part, f"{name}[{number}]", origin, moved)
            for number, part in enumerate(getattr(stage, name))
        )
        for name in ("gaussians", "meshes", "lights")
    }
    return stage.model_copy(update=parts), tuple(moved)


def places_note(origin: Origin) -> str:
    """Return the sentence about which origin the places of a scene's stages are."""
    return (
        f"Places of the stage are about the scene's local origin {describe_origin(origin)}; those of a map "
        "may be given whole, too."
    )


def _placed_about(part: PlacedT, key: str, origin: Origin, moved: list[str]) -> PlacedT:
    changes: dict[str, Any] = {}
    for name in ("position", "origin"):
        place = getattr(part, name, None)
        if place is not None and _is_far(place, origin):
            changes[name] = tuple(float(x) for x in np.array(place) - np.array(origin))
            moved.append(f"{key}.{name}")
    if keys := getattr(part, "keys", ()):
        changes["keys"] = tuple(
            _placed_about(each, f"{key}.keys[{number}]", origin, moved) for number, each in enumerate(keys)
        )
    rest = getattr(part, "on", None)
    if rest is not None:
        changes["on"] = _placed_about(rest, f"{key}.on", origin, moved)
    return part.model_copy(update=changes)


def _is_far(place: tuple[float, float, float], origin: Origin) -> bool:
    offset = np.array(place) - np.array(origin)
    # nearer to the origin than to zero: it is whole
    return bool(np.linalg.norm(offset) < np.linalg.norm(place) / 2)
