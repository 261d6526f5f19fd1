"""3D Tiles (OGC 1.1) of Gaussians: levels of detail in tiles, which a viewer of the globe loads as it needs.

``tileset.json`` (https://docs.ogc.org/cs/22-025r4/22-025r4.html) and a folder of GLBs, a binary tree whose
tiles replace each other: the root has the coarsest level, and a tile has what lies in its cell, of the level
of its depth. Tiles are z up, their contents y up; the transform of the root puts the scene on the Earth.
"""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int

from octasplat.engine.core.earth_frame import geocentric_from_metres
from octasplat.engine.core.local_origin import is_set
from octasplat.engine.core.partial_folders import partial_folder
from octasplat.engine.core.writing import write_text
from octasplat.engine.files.compressed_khr_glb import EXTENSIONS, write_compressed_glb
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.folders_of_parts import former_folders, move_into_place
from octasplat.engine.files.kd_cells import halve_points
from octasplat.engine.files.range_losses import find_position_losses
from octasplat.engine.files.registry import Exporter, register
from octasplat.engine.files.splat_rows import check_scales, iterate_blocks, select_for_export
from octasplat.engine.files.spz import find_range_losses, least_step
from octasplat.engine.files.tile_tree import TileContent, tileset_json
from octasplat.engine.gaussians.levels_of_detail import iterate_levels, level_counts
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata

FORMAT = "3d-tiles"
INDEX_FILE = "tileset.json"
CONTENT_FOLDER = "tiles"
FEWEST_IN_ROOT = 20_000
"""The root has at least so many Gaussians, if the scene has, and less than twice as many; others about so."""
REACH_SIGMAS = 3.0
"""Of a Gaussian in its box."""
_TILE_FROM_SCENE = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From y down to z up: by the half turn about x in the contents, and the quarter turn of glTF in tiles."""


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the index and, in a folder beside it, the tiles; returns the index first.

    Raises:
        SceneFileError: nothing to write, values that are not finite, sizes beyond float32, positions too far
            apart, or files that are no tiles are in the way.
        OSError: a file cannot be written.
    """
    scene = select_for_export(gaussians, path, options)
    check_scales(scene, path)
    former = former_folders(path, _content_folders, _are_tiles)
    depth = len(level_counts(len(scene), FEWEST_IN_ROOT)) - 1
    cells = halve_points(scene.means_world, depth)
    with partial_folder(path) as folder:
        index = folder / INDEX_FILE
        (index.parent / CONTENT_FOLDER).mkdir()
        contents: dict[tuple[int, int], TileContent] = {}
        for finer, level in enumerate(iterate_levels(scene, FEWEST_IN_ROOT, path.parent)):
            at = depth - finer
            numbers = cells.cells_of(level.means_world, at)
            for cell, part in _parts(level, numbers):
                contents[at, cell] = _write_content(part, index, f"{CONTENT_FOLDER}/{at}_{cell}.glb")
        document = tileset_json(
            contents, depth, transform=root_transform(options.facts), content_extensions=EXTENSIONS
        )
        write_text(index, json.dumps(document, indent=1, allow_nan=False) + "\n")
        return move_into_place(index, path, former)


def root_transform(facts: SceneMetadata) -> Float64[np.ndarray, "4 4"] | None:
    """Return what takes tiles of a scene to geocentric metres; to metres, if its place is not known.

    None where tiles are as they should be: without a georeference, and about the origin of its coordinates.
    """
    given = facts.georeference
    if given is None and not is_set(facts.origin_world):
        return None
    placed = np.eye(4)
    placed[:3, 3] = facts.origin_world
    if given is not None:
        frame = geocentric_from_metres(given)
        placed = given.metres_from_scene @ placed
        placed = placed if frame is None else frame @ placed
    return np.asarray(placed @ _TILE_FROM_SCENE.T)


def _parts(level: FlatGaussians, numbers: Int[np.ndarray, " n"]) -> Iterator[tuple[int, FlatGaussians]]:
    """Yield the cells that have Gaussians with these, in their order."""
    order = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers))
    for cell, rows in enumerate(np.split(order, ends[:-1])):
        if len(rows):
            yield cell, level.select(rows)


def _write_content(part: FlatGaussians, index: Path, uri: str) -> TileContent:
    low, high = part.means_world.min(axis=0), part.means_world.max(axis=0)
    centre = (low.astype(np.float64) + high.astype(np.float64)) / 2.0
    write_compressed_glb(part, index.parent / uri, centre)
    lows, highs = zip(*map(_reach, iterate_blocks(part)), strict=True)
    size = float(np.exp(np.median(part.log_scales.max(axis=1).astype(np.float64))))
    return TileContent(uri, np.min(lows, axis=0), np.max(highs, axis=0), size)


def _reach(some: FlatGaussians) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
    """Return the corners of a box about Gaussians, in the frame of tiles."""
    axes = some.rotations[:, :, 1:].astype(np.float64) * some.scales.astype(np.float64)[:, None, :]
    reach = REACH_SIGMAS * np.linalg.norm(axes, axis=2)
    turn = _TILE_FROM_SCENE[:3, :3]
    means = some.means_world.astype(np.float64) @ turn.T
    reach = reach @ np.abs(turn).T
    return (means - reach).min(axis=0), (means + reach).max(axis=0)


def _content_folders(path: Path) -> tuple[str, ...]:
    """Return the folder of tiles that an index, if there is one, names beside it."""
    try:
        waiting = [json.loads(path.read_text(encoding="utf-8"))["root"]]
        while waiting:
            tile = waiting.pop()
            if tile.get("content", {}).get("uri", "").startswith(f"{CONTENT_FOLDER}/"):
                return (CONTENT_FOLDER,)
            waiting += tile.get("children", [])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        pass
    return ()


def _are_tiles(names: frozenset[str]) -> bool:
    return bool(names) and all(name.endswith(".glb") for name in names)


def _find_losses(scene: FlatGaussians) -> tuple[str, ...]:
    if len(scene) == 0 or not scene.is_finite():
        return ()  # which is refused
    sizes, harmonics = find_range_losses(FORMAT, scene)
    return (*sizes, *_find_position_losses(scene), *harmonics)


def _find_position_losses(scene: FlatGaussians) -> tuple[str, ...]:
    """Return what becomes of Gaussians that share a tile with others far away."""
    means = scene.means_world
    whole = least_step(float((means.max(axis=0).astype(np.float64) - means.min(axis=0)).max()) / 2.0)
    if not find_position_losses(FORMAT, scene, lambda _rows: float(whole)):
        return ()  # no tile is larger than the scene
    depth = len(level_counts(len(scene), FEWEST_IN_ROOT)) - 1
    numbers = halve_points(means, depth).cells_of(means, depth)
    farthest = np.zeros(int(numbers.max()) + 1)
    for cell, part in _parts(scene.with_base_color_only(), numbers):
        low, high = part.means_world.min(axis=0), part.means_world.max(axis=0)
        farthest[cell] = float((high.astype(np.float64) - low).max()) / 2.0
    steps = least_step(farthest)
    return find_position_losses(FORMAT, scene, lambda rows: steps[numbers[rows]])


def _find_place_losses(facts: SceneMetadata) -> tuple[str, ...]:
    """Return why tiles of a scene do not stand on the Earth, if they do not."""
    given = facts.georeference
    if given is not None and geocentric_from_metres(given) is not None:
        return ()
    if given is None or given.anchor is None:
        reason = "the scene has no place on the Earth (docs/georeference.md)"
    else:
        reason = f"{given.crs} is not known here (EPSG:4979 and UTM are)"
    frame = "in the coordinates of the scene" if given is None else "in metres about its origin"
    return (
        f"The format {FORMAT} stands on the globe, but {reason}: its tiles are {frame}, z up; set the "
        "transform of its root, or modelMatrix in CesiumJS.",
    )


register(
    Exporter(
        FORMAT,
        (INDEX_FILE,),
        "levels of detail as 3D Tiles with KHR_gaussian_splatting, for CesiumJS",
        write,
        holds_harmonics=True,
        holds_origin=True,
        find_losses=_find_losses,
        find_place_losses=_find_place_losses,
    )
)
