"""Poses and points of many photographs from matches, by COLMAP's global mapper, on one thread.

It averages the rotations of all pairs, then solves for all places and points at once, where the incremental
mapper adds one photograph after the other and adjusts all of them again and again (Pan, Baráth, Pollefeys and
Schönberger, "Global Structure-from-Motion Revisited", https://arxiv.org/abs/2407.20219). It places a
photograph that few matches hold anywhere, so such photographs are taken out again: the incremental mapper
goes on with them.
"""

import shutil
from pathlib import Path
from typing import Any

import pycolmap

from octasplat.engine.core.scene_layout import MIN_PHOTOGRAPHS
from octasplat.engine.poses.incremental_mapping import model_rank

MIN_OBSERVATIONS = 60
"""Points that a photograph must see to keep its place: twice what the incremental mapper asks of one."""
_ADJUSTMENT_STEPS = 20
"""Iterations of each adjustment of all photographs, instead of 200."""
_TRACKS_PER_PHOTOGRAPH = 300
"""Points that places are solved with; all others are triangulated in the end. More of them take longer and
give the same poses."""
_MAX_REPROJECTION_ERROR_PX, _MIN_ANGLE_DEGREES = 4.0, 1.5
"""Of observations and points that are kept: the limits of the incremental mapper."""


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
        _drop_wrong_observations(model)
        take_out_weak_photographs(model)
        _adjust(model)
    return sorted((m for m in models.values() if m.num_reg_images()), key=model_rank, reverse=True)


def _drop_wrong_observations(model: Any) -> None:
    """Drop what the incremental mapper would not have kept, as the global one ends with wider limits."""
    pycolmap.ObservationManager(model).filter_all_points3D(_MAX_REPROJECTION_ERROR_PX, _MIN_ANGLE_DEGREES)


def _adjust(model: Any) -> None:
    """Adjust poses, points and lenses together, in place."""
    if not model.num_reg_images():
        return
    options = pycolmap.BundleAdjustmentOptions()
    options.ceres.use_gpu = False
    options.ceres.solver_options.max_num_iterations = _ADJUSTMENT_STEPS
    options.ceres.solver_options.num_threads = 1
    options.print_summary = False
    pycolmap.bundle_adjustment(model, options)
    model.update_point_3d_errors()


def take_out_weak_photographs(model: Any) -> None:
    """Take the poses from photographs that see fewer than ``MIN_OBSERVATIONS`` points, in place."""
    while weak := [k for k in model.reg_image_ids() if model.image(k).num_points3D < MIN_OBSERVATIONS]:
        for number in weak:  # which takes points from others
            model.deregister_frame(model.image(number).frame_id)
