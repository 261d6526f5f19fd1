"""Datasets that the project makes itself: a still life or a street, ray-traced, with a COLMAP model.

A scene folder holds::

    images/view_000.png ...           photographs, RGB (or RGBA with straight alpha)
    sparse/0/                         COLMAP model, binary: cameras, rigs, frames, images, points with tracks
    masks/view_000.png.png ...        object masks, only if asked for
    ground_truth/depth/view_000.exr   z in the camera frame at pixel centres, metres, 0 = nothing hit
    ground_truth/normals/view_000.exr unit normals of the triangles in the world frame, towards the camera
    ground_truth/masks/view_000.png   white where the pixel's centre shows the table or a thing on it
    ground_truth/mesh.ply             everything as one triangle mesh, in the world frame
    generated.json                    the settings, written last

The world is in metres, z up, the table top in the plane z = 0 around the origin; or the street along x, and
the ground in that plane.
"""

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from octasplat.engine.core.errors import DatasetError, OutputError
from octasplat.engine.core.partial_folders import partial_folder
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.synthetic.config import CAMERA_MODELS, SyntheticDatasetConfig

__all__ = ["CAMERA_MODELS", "SyntheticDatasetConfig", "write_synthetic_dataset"]

# Raised whenever the same settings give other files than before.
_FORMAT_VERSION = 1
_STAMP = "generated.json"


def write_synthetic_dataset(
    root: Path,
    config: SyntheticDatasetConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write the synthetic dataset into the folder ``root``, completely or not at all.

    The scene is built in a folder beside ``root`` that takes its place at the end. Where the same scene is
    already complete, nothing is done.

    Args:
        root: A folder that does not exist, is empty, or holds the same scene.
        config: What to make; the default settings if not given.
        progress: Called with the number of photographs done and their total.

    Raises:
        DatasetError: If ``root`` holds anything else.
        OutputError: If the folder that holds ``root`` cannot be written to.
    """
    config = SyntheticDatasetConfig() if config is None else config
    stamp = {"version": _FORMAT_VERSION, "config": config.as_dict()}
    if root.exists() and not root.is_dir():
        raise DatasetError(f"{root} is a file; name a folder for the generated scene.")
    if root.is_dir() and any(root.iterdir()):
        _check_stamp(root, stamp)
        return

    # Imported here so that the settings can be used without the ray tracer and the compiler.
    from octasplat.engine.dataset.synthetic.write import write_dataset_files

    root = root.resolve()
    with ExitStack() as stack:
        try:
            partial = stack.enter_context(partial_folder(root))
        except OSError as error:
            raise OutputError(
                f"{root.parent} cannot be written to; name another folder ({error.strerror})."
            ) from error
        write_dataset_files(partial, config, progress or (lambda _done, _total: None))
        write_json(partial / _STAMP, stamp)
        _replace_root(partial, root)


def _replace_root(partial: Path, root: Path) -> None:
    """Rename the finished folder; an empty ``root`` is replaced, one that was filled meanwhile is not."""
    try:
        partial.rename(root)
    except OSError as error:
        raise DatasetError(f"{root} was filled by another program meanwhile; name another folder.") from error


def _check_stamp(root: Path, stamp: dict[str, object]) -> None:
    """Raise unless the folder's stamp says that it holds just this scene."""
    try:
        found = json.loads((root / _STAMP).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{root} holds files but no complete generated scene; empty it or name another folder."
        ) from error
    # What earlier versions wrote lacks settings that have come since; they had the defaults.
    found_config = {**SyntheticDatasetConfig().as_dict(), **found.get("config", {})}
    if {**found, "config": found_config} != stamp:
        raise DatasetError(
            f"{root} holds a generated scene made with other settings; delete it or name another folder."
        )
