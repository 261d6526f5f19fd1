"""Whether what a search has mapped can be trusted, and which of two searches came to more."""

from collections.abc import Mapping

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import EventListener, Warned
from octasplat.engine.core.scene_layout import MIN_PHOTOGRAPHS
from octasplat.engine.poses.disambiguation import MappedModels, describe_gps_contradictions
from octasplat.engine.poses.incremental_mapping import best_rank, model_rank
from octasplat.engine.poses.model_selection import (
    describe_parts,
    distinct_models,
    is_trustworthy,
    photograph_indices,
)


def search_rank(mapped: MappedModels, photographs: int, min_share: float) -> tuple[bool, int, int]:
    """Return the sort key of searches: models that GPS contradicts come last, then as models do.

    Args:
        mapped: what a search came to.
        photographs: how many there are.
        min_share: of them, that must get a pose.
    """
    is_enough = mapped.placed(photographs) >= min_share * photographs
    return is_enough and mapped.gps_error_m is None, *best_rank(mapped.models)


def check_mapped(
    mapped: MappedModels, names: Mapping[str, str], min_share: float, progress: EventListener
) -> None:
    """Refuse a result that would only waste the training, and warn of what it lacks.

    Args:
        mapped: what the search came to.
        names: of all photographs, by those of the models' images.
        min_share: of the photographs, that must get a pose.
        progress: hears the warnings.

    Raises:
        DatasetError: too few photographs have poses, or these do not fit.
    """
    count, models = len(names), mapped.models
    if not models:
        raise DatasetError(
            "No poses were found: the photographs do not overlap enough, or are blurred or plain; "
            "take more of them from nearby places, or send a COLMAP model."
        )
    posed, points = model_rank(models[0])
    advice = "take more photographs with more overlap, of things that stand still, or send a COLMAP model."
    if mapped.placed(count) < max(MIN_PHOTOGRAPHS, min_share * count):
        raise DatasetError(
            f"Only {posed} of {count} photographs could be placed{describe_parts(models, names)}; {advice}"
        )
    error_px = float(models[0].compute_mean_reprojection_error())
    if not is_trustworthy(models[0]):
        raise DatasetError(
            f"The poses are not to be trusted ({points} points, {error_px:.1f} px mean error); {advice}"
        )
    for sentence in describe_gps_contradictions(mapped):
        progress(Warned(sentence))
    if left := count - len(photograph_indices(distinct_models(models))):
        progress(Warned(f"{left} of {count} photographs could not be placed and are left out."))
