"""Streamed SOG of PlayCanvas: levels of detail of a scene, in chunks that a viewer loads as it needs them.

An index ``lod-meta.json`` (https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/streamed-sog/)
and a folder for each chunk of a level. The levels are made here, each by merging neighbors of the one before;
the program splat-transform cuts and packs them, where that is.
"""

import json
import re
import shutil
import tempfile
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.files.registry import Exporter, register
from octasplat.engine.files.sog import META_FILE, find_sog_losses
from octasplat.engine.files.splat_rows import select_for_export
from octasplat.engine.files.splat_transform import convert_levels, missing_converter
from octasplat.engine.gaussians.model import FlatGaussians

INDEX_FILE = "lod-meta.json"
_CHUNK_META = re.compile(r"(\d+_\d+)/meta\.json")
MAX_LEVELS = 6
MIN_LEVEL_COUNT = 5_000
"""Fewer Gaussians are not thinned any more: they are loaded at once."""
CHUNKS_ACROSS = 4
"""Chunks along the longest side of where most Gaussians lie; more where these are too many for one."""


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the index and, in its folder, the chunks; returns the index first.

    Raises:
        SceneFileError: nothing to write, values that are not finite, or the program is missing or fails.
        OSError: a file cannot be written.
    """
    # imported late: the table of formats is read where nothing is written, too
    from octasplat.engine.gaussians.simplification import simplify

    scene = select_for_export(gaussians, path, options)
    former = _former_chunks(path)
    low, high = np.quantile(scene.means_world, [0.02, 0.98], axis=0)
    extent_world = float((high - low).max()) / CHUNKS_ACROSS
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="octasplat-", dir=path.parent) as folder:
        levels: list[Path] = []
        while True:
            levels.append(Path(folder) / f"level_{len(levels)}.ply")
            write_gaussian_ply(scene, levels[-1])
            if len(levels) == MAX_LEVELS or len(scene) < 2 * MIN_LEVEL_COUNT:
                break
            scene = simplify(scene, len(scene) // 2)
        index = Path(folder) / "packed" / INDEX_FILE
        index.parent.mkdir()
        try:
            convert_levels(levels, index, chunk_extent_world=extent_world)
        except SceneFileError as error:
            raise SceneFileError(str(error).replace(str(index), str(path), 1)) from error
        return _move_into_place(index, path, former)


def _former_chunks(path: Path) -> frozenset[str]:
    """Return the folders of the chunks that an index, if there is one, names beside it."""
    try:
        names = json.loads(path.read_text(encoding="utf-8"))["filenames"]
        found = {match[1] for name in names if (match := _CHUNK_META.fullmatch(name))}
    except (OSError, ValueError, KeyError, TypeError):
        return frozenset()
    return frozenset(name for name in found if _holds_a_chunk_alone(path.parent / name))


def _holds_a_chunk_alone(folder: Path) -> bool:
    """Return whether a folder holds the files of a chunk, and nothing that somebody put there."""
    names = {file.name for file in folder.iterdir()} if folder.is_dir() else set()
    return META_FILE in names and all(name == META_FILE or name.endswith(".webp") for name in names)


def _move_into_place(index: Path, path: Path, former: frozenset[str]) -> tuple[Path, ...]:
    """Move the chunks beside the place of the index, then the index; return all files, the index first.

    Chunks of the scene that lay there are removed; other folders of their names are not.
    """
    chunks = sorted(folder for folder in index.parent.iterdir() if folder.is_dir())
    for chunk in chunks:
        if (path.parent / chunk.name).exists() and chunk.name not in former:
            raise SceneFileError(
                f"{path}: not written, as {path.parent / chunk.name} is there already and no part of it; "
                "name a file in a folder of its own."
            )
    path.unlink(missing_ok=True)  # from now on it would name what is not there
    for name in former:
        shutil.rmtree(path.parent / name)
    moved: list[Path] = []
    for chunk in chunks:
        target = path.parent / chunk.name
        shutil.move(chunk, target)
        moved += sorted(file for file in target.rglob("*") if file.is_file())
    with atomic_replace(path) as temporary:
        shutil.copyfile(index, temporary)
    return (path, *moved)


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
