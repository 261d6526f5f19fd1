"""Poses and points from matches, by COLMAP's incremental mapper, on one thread.

Bundle adjustment adds up in the order in which its threads come, so more of them would give other digits, and
now and then other photographs; most of the mapper runs on one thread anyway.
"""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pycolmap

from octasplat.engine.core.scene_layout import MIN_PHOTOGRAPHS

OnCount = Callable[[int], None]

_LARGE_GROWTH = 1.4
"""Of a large capture all is adjusted after it has grown by so much, instead of 1.1."""
_LARGE_REFINEMENTS = 2
"""Adjustments in a row at most, instead of 5."""
_LARGE_ADJUSTMENT_STEPS = 20
"""Iterations of each, instead of 50."""
_LARGE_TOLERANCE = 1e-5
"""Relative fall of the cost at which one ends."""
_WEAK_INLIERS = 15
"""Matches by which a photograph can be placed where the usual 30 leave some out."""
_WEAK_INITIAL_INLIERS = 50
"""The same for the first two."""


def map_photographs(
    database: Path,
    photographs: Path,
    *,
    seed: int,
    on_count: OnCount,
    is_large: bool = False,
    allow_weak_links: bool = False,
    start: Path | None = None,
) -> list[Any]:
    """Reconstruct the photographs incrementally and return the models, that with the most of them first.

    Several come of photographs that fall apart, as of two places that nothing links.

    Args:
        database: with matches.
        photographs: folder.
        seed: of everything random.
        on_count: hears of photographs of the largest model so far.
        is_large: adjust all photographs less often and with fewer steps.
        allow_weak_links: place photographs by fewer matches, too.
        start: folder of a model to go on from.

    Returns:
        Each a ``pycolmap.Reconstruction``; none where nothing fits together.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    options.ba_use_gpu = False
    options.min_model_size = MIN_PHOTOGRAPHS
    # It tries photographs whose points are not known yet by RANSAC of a solver that takes milliseconds, up to
    # minutes for each photograph that matches falsely, as all do of another place.
    options.structure_less_registration_fallback = False
    options.extract_colors = False  # extracted once, for the model that is kept
    if is_large:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = _LARGE_GROWTH
        options.ba_global_max_refinements = _LARGE_REFINEMENTS
        options.ba_global_max_num_iterations = _LARGE_ADJUSTMENT_STEPS
        options.ba_global_function_tolerance = options.ba_local_function_tolerance = _LARGE_TOLERANCE
    if allow_weak_links:
        options.mapper.abs_pose_min_num_inliers = _WEAK_INLIERS
        options.mapper.init_min_num_inliers = _WEAK_INITIAL_INLIERS
    placed = len(pycolmap.Reconstruction(start).reg_image_ids()) if start is not None else 0
    most = placed

    def first_pair() -> None:
        nonlocal placed
        placed = 2  # a new model begins: its photographs are counted anew

    def another() -> None:
        nonlocal placed, most
        placed += 1
        if placed > most:
            most = placed
            on_count(most)  # a smaller model is no progress

    folder = database.with_name("models")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    pycolmap.set_random_seed(seed)
    models: dict[int, Any] = pycolmap.incremental_mapping(
        database,
        photographs,
        folder,
        options=options,
        input_path=start or "",
        initial_image_pair_callback=first_pair,
        next_image_callback=another,
    )
    return sorted(models.values(), key=model_rank, reverse=True)


def model_rank(model: Any) -> tuple[int, int]:
    """Return the sort key of models: the count of registered photographs, then of points."""
    return (model.num_reg_images(), model.num_points3D())


def best_rank(models: Sequence[Any]) -> tuple[int, int]:
    """Return the sort key of what a mapping came to: that of its first model."""
    return model_rank(models[0]) if models else (0, 0)
