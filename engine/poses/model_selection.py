"""The models of a mapping that are worth to be kept, and what is recorded of each."""

from collections.abc import Mapping, Sequence
from typing import Any

from octasplat.engine.core.name_lists import name_list
from octasplat.engine.core.scene_layout import MIN_PHOTOGRAPHS
from octasplat.engine.poses.config import MAX_REPROJECTION_PX, MIN_POINTS


def distinct_models(models: Sequence[Any]) -> list[Any]:
    """Return the first model, and each further one that places photographs which no model before it does.

    It must do so with enough of them for a training, and be as sure as the first one has to be.

    Args:
        models: ``pycolmap.Reconstruction`` each, that of most photographs first.
    """
    kept = list(models[:1])
    posed = {number for model in kept for number in model.reg_image_ids()}
    for model in models[1:]:
        new = set(model.reg_image_ids()) - posed
        if len(new) >= MIN_PHOTOGRAPHS and is_trustworthy(model):
            kept.append(model)
            posed |= new
    return kept


def photograph_indices(models: Sequence[Any]) -> set[int]:
    """Return the indices, from 0, of the photographs that models place."""
    return {number - 1 for model in models for number in model.reg_image_ids()}


def is_trustworthy(model: Any) -> bool:
    """Return whether a model has enough points, and these fit the photographs."""
    return model.num_points3D() >= MIN_POINTS and (
        float(model.compute_mean_reprojection_error()) <= MAX_REPROJECTION_PX
    )


def model_facts(model: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return what is recorded of a found model.

    Args:
        model: a ``pycolmap.Reconstruction`` whose images have the names of photographs.
        names: of all photographs.
    """
    posed = {model.image(number).name for number in model.reg_image_ids()}
    return {
        "photographs": len(names),
        "placed": len(posed),
        "left_out": [name for name in names if name not in posed],
        "points": model.num_points3D(),
        "mean_reprojection_px": round(float(model.compute_mean_reprojection_error()), 4),
    }


def describe_parts(models: Sequence[Any], names: Mapping[str, str]) -> str:
    """Return which models there are beside the first, for a sentence; empty where there are none.

    Args:
        models: ``pycolmap.Reconstruction`` each, that of most photographs first.
        names: of the photographs, by those of the models' images.
    """
    parts = [
        (model.num_reg_images(), sorted(names[model.image(k).name] for k in model.reg_image_ids()))
        for model in distinct_models(models)[1:]
    ]
    listed = ", ".join(f"{placed} ({name_list(which)})" for placed, which in parts)
    return f" together, apart from models of {listed} that no matches link" if parts else ""
