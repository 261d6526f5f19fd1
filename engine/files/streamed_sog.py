"""Streamed SOG of PlayCanvas: levels of detail of a scene, in chunks that a viewer loads as it needs them.

An index ``lod-meta.json`` (https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/)
and a folder for each chunk of a level. The levels are made here, each by merging neighbors of the one before;
the program splat-transform cuts and packs them, where that is.
"""

import json
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.partial_folders import partial_folder
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.folders_of_parts import former_folders, move_into_place
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.files.registry import Exporter, register
from octasplat.engine.files.sog import META_FILE, find_sog_losses
from octasplat.engine.files.splat_rows import select_for_export
from octasplat.engine.files.splat_transform import convert_levels, missing_converter
from octasplat.engine.gaussians.levels_of_detail import iterate_levels
from octasplat.engine.gaussians.model import FlatGaussians

INDEX_FILE = "lod-meta.json"
_CHUNK_META = re.compile(r"(\d+_\d+)/meta\.json")
MAX_LEVELS = 6
MIN_LEVEL_COUNT = 5_000
"""Fewer Gaussians are not thinned any more: they are loaded at once."""
SPREAD_QUANTILES = (0.02, 0.98)
"""Between which most Gaussians lie."""
CHUNKS_ACROSS = 4
"""Chunks along the longest side of where most Gaussians lie; more where these are too many for one."""


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the index and, in its folder, the chunks; returns the index first.

    Raises:
        SceneFileError: nothing to write, values that are not finite, or the program is missing or fails.
        OSError: a file cannot be written.
    """
    scene = select_for_export(gaussians, path, options)
    former = former_folders(path, _chunk_names, _are_of_a_chunk)
    extent_world = max(map(_spread, scene.means_world.T)) / CHUNKS_ACROSS
    with partial_folder(path) as folder:
        levels: list[Path] = []
        for level in iterate_levels(scene, MIN_LEVEL_COUNT, path.parent, MAX_LEVELS):
            levels.append(folder / f"level_{len(levels)}.ply")
            write_gaussian_ply(level, levels[-1])
        index = folder / "packed" / INDEX_FILE
        index.parent.mkdir()
        try:
            convert_levels(levels, index, chunk_extent_world=extent_world)
        except SceneFileError as error:
            raise SceneFileError(str(error).replace(str(index), str(path), 1)) from error
        return move_into_place(index, path, former)


def _spread(coordinates: Float32[np.ndarray, " n"]) -> float:
    """Return how far most of some coordinates lie apart."""
    low, high = np.quantile(coordinates, SPREAD_QUANTILES)
    return float(high - low)


def _chunk_names(path: Path) -> frozenset[str]:
    """Return the folders of the chunks that an index, if there is one, names beside it."""
    try:
        names = json.loads(path.read_text(encoding="utf-8"))["filenames"]
        return frozenset(match[1] for name in names if (match := _CHUNK_META.fullmatch(name)))
    except (OSError, ValueError, KeyError, TypeError):
        return frozenset()


def _are_of_a_chunk(names: frozenset[str]) -> bool:
    return META_FILE in names and all(name == META_FILE or name.endswith(".webp") for name in names)


register(
    Exporter(
        "streamed-sog",
        (INDEX_FILE,),
        "levels of detail in chunks, for viewers that load what they need; needs splat-transform",
        write,
        missing_converter,
        holds_harmonics=True,
        find_losses=find_sog_losses,
    )
)
