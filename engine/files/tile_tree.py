"""The tree of a 3D Tiles tileset: boxes, geometric errors and the index that says them.

Boxes hold those of all tiles below. Errors are those of the Gaussians' sizes, and grow towards the root.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

ERROR_PER_SIZE = 8.0
"""Geometric error of a tile for the size of its Gaussians: viewers that draw what is off by up to 16 pixels,
as CesiumJS does, refine where the standard deviation of a typical one is 2 pixels."""
ERROR_GROWTH = 2.0**0.5
"""Least growth from a tile to its parent: that of distances on a surface which loses every other point."""


@dataclass(frozen=True, eq=False)
class TileContent:
    """What one file of a tile has.

    Attributes:
        uri: of the file, relative to the index.
        low: corner of its box in the frame of tiles.
        high: the other corner.
        size: the middle one of the larger standard deviations of its Gaussians.
    """

    uri: str
    low: Float64[np.ndarray, "3"]
    high: Float64[np.ndarray, "3"]
    size: float


TileContents = Mapping[tuple[int, int], TileContent]
"""By depth and cell; those of cell c are 2 c and 2 c + 1 of the next depth."""


@dataclass(frozen=True, eq=False)
class _Tile:
    """A tile as the index has it, and what its parent has to know."""

    json: dict[str, object]
    low: Float64[np.ndarray, "3"]
    high: Float64[np.ndarray, "3"]
    size: float
    error: float


def tileset_json(
    contents: TileContents,
    depth: int,
    *,
    transform: Float64[np.ndarray, "4 4"] | None,
    content_extensions: tuple[str, ...],
) -> dict[str, object]:
    """Return the index of a tree in which tiles are replaced by those below.

    Args:
        contents: of the tiles that have any; one at least.
        depth: of the deepest ones.
        transform: of the root.
        content_extensions: of glTF, that a viewer needs to know.
    """
    root = _tile(contents, depth, 0, 0)
    assert root is not None
    used = list(content_extensions)
    placed = {} if transform is None else {"transform": transform.T.reshape(-1).tolist()}
    # nothing drawn at all is off by the whole scene
    error = max(float(np.linalg.norm(root.high - root.low)), ERROR_GROWTH * root.error)
    return {
        "asset": {"version": "1.1", "generator": "octasplat"},
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": {"extensionsUsed": used, "extensionsRequired": used}},
        "geometricError": error,
        "root": {**placed, "refine": "REPLACE", **root.json},
    }


def _tile(contents: TileContents, depth: int, at: int, cell: int) -> _Tile | None:
    """Return the tile of a cell with all below it; None where there are no Gaussians."""
    children: list[_Tile] = []
    if at < depth:
        below = (_tile(contents, depth, at + 1, number) for number in (2 * cell, 2 * cell + 1))
        children = [tile for tile in below if tile is not None]
    content = contents.get((at, cell))
    boxes: list[_Tile | TileContent] = [*children, *([content] if content is not None else [])]
    if not boxes:
        return None
    low = np.min([box.low for box in boxes], axis=0)
    high = np.max([box.high for box in boxes], axis=0)
    size = content.size if content is not None else max(child.size for child in children)
    error = 0.0
    if children:
        error = max(ERROR_PER_SIZE * size, *(ERROR_GROWTH * child.error for child in children))
    described: dict[str, object] = {"boundingVolume": _box_json(low, high), "geometricError": error}
    if content is not None:
        described["content"] = {"uri": content.uri}
    if children:
        described["children"] = [child.json for child in children]
    return _Tile(described, low, high, size, error)


def _box_json(low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"]) -> dict[str, object]:
    half = (high - low) / 2.0
    return {"box": [*((low + high) / 2.0).tolist(), *np.diag(half).reshape(-1).tolist()]}
