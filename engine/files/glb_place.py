"""Where the root node of a GLB puts a scene: upright, at its local origin, and in a georeference.

The georeference stands in the node's extras and moves nothing: ``matrix``, in columns as glTF has it, takes
positions of the file's scene to metres east, north and up about ``anchor``, which is in the coordinates
``crs``.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.georeference import Georeference, matrix_rows
from octasplat.engine.core.local_origin import Origin, is_set
from octasplat.engine.gaussians.frames import rotation_matrices

HALF_TURN_ABOUT_X = [1.0, 0.0, 0.0, 0.0]
"""x, y, z, w, as glTF writes quaternions; brings COLMAP's frame (y down, z forward) to glTF's (y up)."""
ORIGIN_KEY = "octasplat_origin"
"""In the extras of a root node: the origin of large coordinates, which its translation adds."""
TURN_KEY = "octasplat_turn"
"""In the extras of a root node whose rotation (x, y, z, w) is another than the half turn about x."""
GEOREFERENCE_KEY = "octasplat_georeference"
"""In the extras of a root node."""


def rotation_of(rotation_xyzw: Sequence[float]) -> Float64[np.ndarray, "3 3"]:
    """Return the matrix of a quaternion as glTF writes it."""
    x, y, z, w = rotation_xyzw
    return np.asarray(rotation_matrices(np.array([[w, x, y, z]], np.float64))[0])


def upright_root(
    rotation_xyzw: Sequence[float], origin: Origin, georeference: Georeference | None
) -> dict[str, object]:
    """Return what a root node says that turns a scene upright: rotation, translation and extras."""
    place = root_place(origin, georeference, rotation_xyzw)
    extras = {**dict(place.pop("extras", {})), TURN_KEY: list(rotation_xyzw)}  # type: ignore[call-overload]
    return {"rotation": list(rotation_xyzw), **place, "extras": extras}


def root_place(
    origin: Origin,
    georeference: Georeference | None,
    rotation_xyzw: Sequence[float] = HALF_TURN_ABOUT_X,
) -> dict[str, object]:
    """Return what a root node says of a scene about a local origin, or in a georeference; else nothing.

    Args:
        origin: in our world frame.
        georeference: of the scene.
        rotation_xyzw: from our frame to glTF's.
    """
    place: dict[str, object] = {}
    extras: dict[str, object] = {}
    if is_set(origin):
        place["translation"] = (rotation_of(rotation_xyzw) @ np.array(origin)).tolist()
        extras[ORIGIN_KEY] = list(origin)
    if georeference is not None:
        extras[GEOREFERENCE_KEY] = _georeference_extras(georeference, rotation_xyzw)
    return {**place, "extras": extras} if extras else {}


def _georeference_extras(georeference: Georeference, rotation_xyzw: Sequence[float]) -> dict[str, object]:
    turn = np.eye(4)
    turn[:3, :3] = rotation_of(rotation_xyzw)
    columns = (georeference.metres_from_scene @ turn.T).T.reshape(-1).tolist()
    if georeference.anchor is None:
        return {"matrix": columns, "turn": list(rotation_xyzw)}
    return {
        "crs": georeference.crs,
        "anchor": list(georeference.anchor),
        "matrix": columns,
        "turn": list(rotation_xyzw),
    }


def georeference_of_nodes(nodes: Sequence[Mapping[str, Any]]) -> Georeference | None:
    """Return the georeference that the nodes of a document say; None where they say none.

    Raises:
        KeyError, IndexError, TypeError, ValueError: they say nonsense.
    """
    for node in nodes:
        extras = node.get("extras", {}).get(GEOREFERENCE_KEY)
        if extras is None:
            continue
        turn = np.eye(4)
        turn[:3, :3] = rotation_of(extras["turn"])
        matrix = np.array(extras["matrix"], np.float64).reshape(4, 4).T @ turn
        return Georeference(crs=extras.get("crs"), anchor=extras.get("anchor"), matrix=matrix_rows(matrix))
    return None
