"""Poses and points from matches, by COLMAP's incremental mapper, on one thread.

Bundle adjustment adds up in the order in which its threads come, so more of them would give other digits, and
now and then other photographs; most of the mapper runs on one thread anyway.
"""

from collections.abc import Callable, Collection, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.scene_layout import MIN_PHOTOGRAPHS
from octasplat.engine.poses.model_selection import photograph_indices
from octasplat.engine.poses.stored_mappings import StoredMapping

OnCount = Callable[[int], None]

_LARGE_GROWTH = 1.4
"""Of a large capture all is adjusted after it has grown by so much, instead of 1.1."""
_LARGE_REFINEMENTS = 2
"""Adjustments in a row at most, instead of 5."""
_LARGE_ADJUSTMENT_STEPS = 20
"""Iterations of each, instead of 50."""
_LARGE_TOLERANCE = 1e-4
"""Relative fall of the cost at which one ends while a model grows ..."""
_COMPLETE_TOLERANCE = 1e-5
"""... and at which the last one of a complete model does, or one of a few photographs."""
_MIN_SEGMENT = 250
"""Photographs of the first segment at least ..."""
_SEGMENT_GROWTH = 1.2
"""... and by which a model grows in any further one."""
_WEAK_INLIERS = 15
"""Matches by which a photograph can be placed where the usual 30 leave some out."""
_WEAK_INITIAL_INLIERS = 50
"""The same for the first two."""


MIN_SEEN_POINTS = 30
"""Points that a photograph placed so has to see in a large capture, whose places may look alike: in a street
ten false ones saw 20 and less, and right ones 60 and more."""


@dataclass(frozen=True)
class Continuation:
    """From where mapping goes on, and what it maps.

    Attributes:
        start: folder of a model to go on from.
        allow_weak_links: place photographs by fewer matches, too.
        apart: complete models, whose photographs are not mapped again.
        left_out: indices of further photographs that are not mapped.
        extends_only: map no models beside ``start``.
    """

    start: Path | None = None
    allow_weak_links: bool = False
    apart: Sequence[Any] = ()
    left_out: Collection[int] = ()
    extends_only: bool = False


FROM_THE_BEGINNING = Continuation()


class _SegmentEndError(Exception):
    """Leaves COLMAP's mapper where a segment ends."""


def map_photographs(
    database: Path,
    *,
    seed: int,
    on_count: OnCount,
    allow_weak_links: bool = False,
    start: Path | None = None,
) -> list[Any]:
    """Reconstruct the photographs incrementally and return the models, that with the most of them first.

    Several come of photographs that fall apart, as of two places that nothing links.

    Args:
        database: with matches.
        seed: of everything random.
        on_count: hears of photographs of the largest model so far.
        allow_weak_links: place photographs by fewer matches, too.
        start: folder of a model to go on from.

    Returns:
        Each a ``pycolmap.Reconstruction``; none where nothing fits together.
    """
    manager = pycolmap.ReconstructionManager()
    if start is not None:
        manager.read(start)
    _run_mapper(_options(seed, allow_weak_links), database, manager, _Count(on_count))
    return sorted(_all_models(manager), key=model_rank, reverse=True)


def map_in_segments(
    database: Path,
    stored: StoredMapping,
    *,
    seed: int,
    on_count: OnCount,
    continuation: Continuation = FROM_THE_BEGINNING,
) -> list[Any]:
    """Reconstruct a large capture as :func:`map_photographs` does, with less effort for each photograph.

    All photographs are adjusted less often and with fewer steps. Now and then, after such an adjustment, the
    model is written and mapping goes on from its files, also where it is not stopped: so a search that was
    stopped gives the same bytes.

    Args:
        database: with matches.
        stored: state of this mapping, from which it goes on.
        seed: of everything random.
        on_count: hears of the photographs in all models so far.
        continuation: from where it goes on, and with which photographs.

    Returns:
        Each a ``pycolmap.Reconstruction``, without those apart; none where nothing fits together.
    """
    options = _options(seed, continuation.allow_weak_links)
    options.multiple_models = not continuation.extends_only
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _LARGE_GROWTH
    options.ba_global_max_refinements = _LARGE_REFINEMENTS
    options.ba_global_max_num_iterations = _LARGE_ADJUSTMENT_STEPS
    options.ba_global_function_tolerance = _LARGE_TOLERANCE
    options.ba_local_function_tolerance = _COMPLETE_TOLERANCE
    count = _Count(on_count)
    while not stored.state.is_done:
        _map_segment(options, database, stored, continuation, count)
    models = stored.models()
    count.tell(len(photograph_indices([*continuation.apart, *models])))
    return sorted(models, key=model_rank, reverse=True)


def _map_segment(
    options: Any, database: Path, stored: StoredMapping, continuation: Continuation, count: "_Count"
) -> None:
    """Map until a segment ends or there is no more to map, and write the state."""
    manager = pycolmap.ReconstructionManager()
    if (begun := stored.state.current or continuation.start) is not None:
        manager.read(begun)
    finished = [*continuation.apart, *stored.models()]
    options.image_names = _names_left(database, finished, _all_models(manager), continuation.left_out)
    is_segment_end = _run_mapper(
        options, database, manager, count, ends_segments=True, finished=photograph_indices(finished)
    )
    models = _all_models(manager)
    if is_segment_end:
        stored.write(models[:-1], models[-1], is_done=False)
    else:
        stored.write(models, None, is_done=True)


def _options(seed: int, allow_weak_links: bool) -> Any:
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
    if allow_weak_links:
        options.mapper.abs_pose_min_num_inliers = _WEAK_INLIERS
        options.mapper.init_min_num_inliers = _WEAK_INITIAL_INLIERS
    return options


def _run_mapper(
    options: Any,
    database: Path,
    manager: Any,
    count: "_Count",
    *,
    ends_segments: bool = False,
    finished: Set[int] = frozenset(),
) -> bool:
    """Run COLMAP's mapper, with a model in ``manager`` to go on from or without; return where it ends.

    Args:
        options: of the mapper.
        database: with matches.
        manager: gets the models.
        count: counts the photographs.
        ends_segments: stop after an adjustment of all photographs of a model that has grown by
            :data:`_SEGMENT_GROWTH`.
        finished: indices of the photographs of models that are complete; of segments, all models count.

    Returns:
        Whether that was the end of a segment; the last model is not complete then.
    """
    pycolmap.set_random_seed(options.random_seed)
    with pycolmap.Database.open(database) as source:
        pipeline = pycolmap.IncrementalPipeline(options, source, manager)
    begun = manager.get(0).num_reg_frames() if manager.size() else 0
    adjusted = (begun, manager.get(0).num_points3D()) if begun else (0, 0)
    segment_end: float = max(_SEGMENT_GROWTH * begun, _MIN_SEGMENT)

    def placed() -> int:
        models = _all_models(manager)
        # models share photographs
        return len(finished | photograph_indices(models)) if ends_segments else models[-1].num_reg_images()

    count.begin(placed() if begun else len(finished))

    def first_pair() -> None:
        nonlocal adjusted, segment_end
        model = manager.get(manager.size() - 1)
        adjusted = model.num_reg_frames(), model.num_points3D()
        segment_end = _MIN_SEGMENT  # of a new model
        count.begin(placed())

    def another() -> None:
        nonlocal adjusted
        count.tell(placed())
        if not ends_segments:
            return
        model = manager.get(manager.size() - 1)
        # as the mapper has just decided
        if pipeline.check_run_global_refinement(model, *adjusted):
            adjusted = model.num_reg_frames(), model.num_points3D()
            if adjusted[0] >= segment_end:
                raise _SegmentEndError

    callbacks = pycolmap.IncrementalPipelineCallback
    pipeline.add_callback(callbacks.INITIAL_IMAGE_PAIR_REG_CALLBACK.value, first_pair)
    pipeline.add_callback(callbacks.NEXT_IMAGE_REG_CALLBACK.value, another)
    is_segment_end = False
    try:
        pipeline.run()
    except _SegmentEndError:
        is_segment_end = True
    if ends_segments:
        models = _all_models(manager)
        for complete in models[:-1] if is_segment_end else models:
            _adjust_complete(complete, pipeline.database_cache, options)
    return is_segment_end


def take_out_unsure(model: Any, sure: Collection[int]) -> None:
    """Take photographs that see few points of a model out of it.

    Args:
        model: a ``pycolmap.Reconstruction``, which is changed.
        sure: indices, from 0, of the photographs that stay in any case.
    """
    for index in sorted(photograph_indices([model]) - set(sure)):
        image = model.image(index + 1)
        if image.num_points3D < MIN_SEEN_POINTS:
            model.deregister_frame(image.frame_id)


def _adjust_complete(model: Any, matches: Any, options: Any) -> None:
    """Adjust all photographs of a complete model until the cost hardly falls any more."""
    adjustment = options.get_global_bundle_adjustment()
    adjustment.ceres.solver_options.function_tolerance = _COMPLETE_TOLERANCE
    mapper = pycolmap.IncrementalMapper(matches)
    mapper.begin_reconstruction(model)
    mapper.iterative_global_refinement(
        options.ba_global_max_refinements,
        options.ba_global_max_refinement_change,
        options.get_mapper(),
        adjustment,
        options.get_triangulation(),
    )
    mapper.end_reconstruction(False)


class _Count:
    """Counts photographs of the models that grow; tells of the most so far, as small models are given up."""

    def __init__(self, on_count: OnCount) -> None:
        self._on_count = on_count
        self._most = 0

    def begin(self, placed: int) -> None:
        """Count from here on."""
        self._most = max(self._most, placed)

    def tell(self, placed: int) -> None:
        """Tell of so many photographs, if they are more than before."""
        if placed > self._most:
            self._most = placed
            self._on_count(placed)


def _all_models(manager: Any) -> list[Any]:
    return [manager.get(k) for k in range(manager.size())]


def _names_left(
    database: Path, finished: Sequence[Any], current: Sequence[Any], left_out: Collection[int]
) -> list[str]:
    """Return the names of the photographs to map: not those of finished models alone, or of ``left_out``.

    Empty, which COLMAP takes for all of them, where no model is finished and none is left out.
    """
    if not finished and not left_out:
        return []
    with pycolmap.Database.open(database) as source:
        names = {image.image_id: image.name for image in source.read_all_images()}
    away = (photograph_indices(finished) | set(left_out)) - photograph_indices(current)
    return sorted(name for number, name in names.items() if number - 1 not in away)


def model_rank(model: Any) -> tuple[int, int]:
    """Return the sort key of models: the count of registered photographs, then of points."""
    return (model.num_reg_images(), model.num_points3D())


def best_rank(models: Sequence[Any]) -> tuple[int, int]:
    """Return the sort key of what a mapping came to: that of its first model."""
    return model_rank(models[0]) if models else (0, 0)
