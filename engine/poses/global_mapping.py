"""Poses and points of many photographs from matches, by COLMAP's global mapper, on one thread.

It averages the rotations of all pairs, then solves for all places and points at once, where the incremental
mapper adds one photograph after the other and adjusts all of them again and again (Pan, Baráth, Pollefeys and
Schönberger, "Global Structure-from-Motion Revisited", https://arxiv.org/abs/2407.20219). It places a
photograph that few matches hold anywhere, so such photographs are taken out again. The incremental mapper
goes on from what is left: it adds points and photographs, and adjusts all of them.
"""

import shutil
from pathlib import Path
from typing import Any

import pycolmap

from octasplat.engine.core.scene_layout import MIN_PHOTOGRAPHS
from octasplat.engine.poses.config import RETRY_BELOW_SHARE
from octasplat.engine.poses.incremental_mapping import model_rank
from octasplat.engine.poses.model_selection import distinct_models, is_trustworthy

MIN_OBSERVATIONS = 60
"""Points that a photograph must see to keep its place: twice what the incremental mapper asks of one."""
_ADJUSTMENT_STEPS = 20
"""Iterations of each adjustment of all photographs, instead of 200."""
_TRACKS_PER_PHOTOGRAPH = 300
"""Points that places are solved with; all others are triangulated in the end. More of them take longer and
give the same poses."""
_MAX_REPROJECTION_ERROR_PX, _MIN_ANGLE_DEGREES = 4.0, 1.5
"""Of observations and points that are kept."""


def map_most_globally(database: Path, photographs: int, seed: int) -> Any | None:
    """Return the largest model of so many photographs; None where their models do not place most of them."""
    models = map_globally(database, seed=seed)
    placed = {number for model in distinct_models(models) for number in model.reg_image_ids()}
    if len(placed) < RETRY_BELOW_SHARE * photographs or not is_trustworthy(models[0]):
        return None
    return models[0]


def map_globally(database: Path, *, seed: int) -> list[Any]:
    """Reconstruct all photographs at once and return the models, that with the most of them first.

    Args:
        database: with matches.
        seed: of everything random.

    Returns:
        Each a ``pycolmap.Reconstruction``, without the photographs that see few of its points; none where
        nothing fits together.
    """
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1  # more would give other digits
    options.random_seed = options.mapper.random_seed = seed
    options.min_model_size = MIN_PHOTOGRAPHS
    options.mapper.global_positioning.use_gpu = False
    options.mapper.track_required_tracks_per_view = _TRACKS_PER_PHOTOGRAPH
    adjustment = options.mapper.bundle_adjustment.ceres
    adjustment.use_gpu = False
    adjustment.solver_options.max_num_iterations = _ADJUSTMENT_STEPS
    folder = database.with_name("models")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    none = database.with_name("no_photographs")
    none.mkdir(exist_ok=True)  # colors are extracted once, for the models that are kept
    pycolmap.set_random_seed(seed)
    models: dict[int, Any] = pycolmap.global_mapping(database, none, folder, options)
    for model in models.values():
        # with the limits of the incremental mapper, as the global one ends with wider ones
        pycolmap.ObservationManager(model).filter_all_points3D(_MAX_REPROJECTION_ERROR_PX, _MIN_ANGLE_DEGREES)
        take_out_weak_photographs(model)
    return sorted((m for m in models.values() if m.num_reg_images()), key=model_rank, reverse=True)


def take_out_weak_photographs(model: Any) -> None:
    """Take the poses from photographs that see fewer than ``MIN_OBSERVATIONS`` points, in place."""
    while weak := [k for k in model.reg_image_ids() if model.image(k).num_points3D < MIN_OBSERVATIONS]:
        for number in weak:  # which takes points from others
            model.deregister_frame(model.image(number).frame_id)
