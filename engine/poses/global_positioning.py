"""Rough poses of all photographs at once, by COLMAP's global mapper without its adjustments, on one thread.

The rotations of all pairs are averaged, and places are solved for together with a few points of each
photograph (Pan, Baráth, Pollefeys and Schönberger, "Global Structure-from-Motion Revisited",
https://arxiv.org/abs/2407.20219). That takes a few per cent of the time of mapping, and tells how parts of a
large capture are turned against each other before hours are spent on them. It is too rough to train on:
single photographs may stand anywhere.
"""

import shutil
from pathlib import Path
from typing import Any

from octasplat.engine.core.colmap_binding import pycolmap

POINTS_PER_PHOTOGRAPH = 50
"""Places are solved for with; each point is in several photographs."""


def position_photographs(database: Path, seed: int) -> Any | None:
    """Return a ``pycolmap.Reconstruction`` of most photographs; None where nothing fits together.

    Args:
        database: with matches.
        seed: of everything random.
    """
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1  # more would give other digits
    options.random_seed = options.mapper.random_seed = seed
    options.min_num_matches = 1  # pairs in the database are verified
    options.mapper.track_required_tracks_per_view = POINTS_PER_PHOTOGRAPH
    options.mapper.global_positioning.use_gpu = False
    options.mapper.skip_bundle_adjustment = options.mapper.skip_retriangulation = True
    folder = database.with_name("positions")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    pycolmap.set_random_seed(seed)
    # in an empty folder there are no photographs to take colors from
    try:
        models = pycolmap.global_mapping(database, folder, folder, options)
    except RuntimeError:  # as of a system that cannot be solved; the mapping does without
        return None
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)
