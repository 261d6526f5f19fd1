"""What all files of USD have in common: whether usd-core is there, and where the root lies."""

import importlib
import importlib.metadata
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.georeference import Georeference
from octasplat.engine.core.local_origin import Origin

ROOT = "/octasplat"
EAST_UP_SOUTH = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From x east, y north and z up to y up."""


def missing_usd() -> str | None:
    """Return what is missing to write USD, without loading it.

    Whether an old copy will do shows when it is used.
    """
    if importlib.util.find_spec("pxr") is None:
        return "needs the package usd-core; install it with pip install 'usd-core>=26.5'"
    try:
        version = importlib.metadata.version("usd-core")
    except importlib.metadata.PackageNotFoundError:  # USD of another package
        return None
    numbers = tuple(int(part) for part in version.split(".")[:2] if part.isdigit())
    return None if numbers >= (26, 5) else f"usd-core {version} is too old; install usd-core 26.5 or later"


def import_usd(path: Path, names: Sequence[str]) -> dict[str, ModuleType]:
    """Return modules of usd-core by name.

    Raises:
        SceneFileError: usd-core is not installed; the text names ``path`` and says what to do.
    """
    try:
        importlib.import_module("pxr")
        return {name: importlib.import_module(f"pxr.{name}") for name in names}
    except ImportError as error:
        raise SceneFileError(f"{path}: {missing_usd() or error}.") from error


def place_in_georeference(
    pxr: dict[str, ModuleType],
    stage: Any,
    root: Any,
    georeference: Georeference,
    origin: Origin,
    scene_from_file: Float64[np.ndarray, "4 4"],
) -> None:
    """Put the root where it lies about the anchor, x east, y up and z south, in units of the scene.

    How many metres a unit is, and where the anchor is, stand in the metadata of the stage.

    Args:
        pxr: UsdGeom and Gf.
        stage: of USD.
        root: its transformable root.
        georeference: of the scene.
        origin: of the scene.
        scene_from_file: from the values in the file to the frame of the scene.
    """
    scale = georeference.metres_per_unit
    pxr["UsdGeom"].SetStageMetersPerUnit(stage, scale)
    shift = np.eye(4)
    shift[:3, 3] = origin
    placed = georeference.metres_from_scene @ shift @ scene_from_file
    placed[:3] /= scale
    set_transform(pxr, root, EAST_UP_SOUTH @ placed)
    known: dict[str, object] = {"axes": "x east, y up, z south, in units of metersPerUnit"}
    if georeference.anchor is not None:
        known |= {"crs": georeference.crs, "anchor": pxr["Gf"].Vec3d(*georeference.anchor)}
    layer = stage.GetRootLayer()
    layer.customLayerData = {"octasplat_georeference": known}


def set_transform(pxr: dict[str, ModuleType], root: Any, matrix: Float64[np.ndarray, "4 4"]) -> None:
    """Give a prim a transform that takes column vectors."""
    # USD multiplies row vectors
    root.AddTransformOp(pxr["UsdGeom"].XformOp.PrecisionDouble).Set(pxr["Gf"].Matrix4d(*matrix.T.ravel()))
