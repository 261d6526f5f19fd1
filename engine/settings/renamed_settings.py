"""Settings and options that were renamed since the last version, whose former names this version still reads.

A model names its part of the tables as ``former_names``; :func:`replace_former_names` alone reads them.
The next version drops this module.
"""

import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from pydantic import BaseModel

from octasplat.engine.settings.refusals import submodels

_SHOWN = 3
"""Renamed settings that one notice names; the file of an earlier run has dozens."""


class RenamedSettingWarning(FutureWarning):
    """A setting or option was given by the name that it had in the last version."""


@dataclass(frozen=True)
class FormerNames:
    """Former names of a model's fields and values, and of the flags of a command.

    Attributes:
        fields: name of each field that was renamed, by its former one.
        values: new value by former one, by the new name of the field.
        flags: name of the field by a former flag that was not ``--name-of-field``.
    """

    fields: Mapping[str, str] = field(default_factory=dict)
    values: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    flags: Mapping[str, str] = field(default_factory=dict)


NONE = FormerNames()
RUN = FormerNames(
    {"evaluate_background": "evaluation_background"},
    {"preset": {"paper": "redisplats"}},
    {"--background": "evaluation_background"},
)
RECONSTRUCT = FormerNames(
    {**RUN.fields, "rays": "rays_per_batch", "assignments": "set", "frames_per_second": "fps"},
    RUN.values,
    RUN.flags,
)
TRAIN = FormerNames(
    {
        "stop_early": "early_stopping_db",
        "rays_a_pixel": "rays_per_pixel",
        "rays": "rays_per_batch",
        "window_rays": "ray_patch_rays",
        "window_side": "ray_patch_side",
        "patch_fraction": "ssim_patch_fraction",
        "patch_side": "ssim_patch_side",
        "fit_iterations": "densify_from_iter",
        "sh_every": "sh_degree_interval",
        "pixels_a_gaussian": "pixels_per_gaussian",
        "plane_points": "normal_neighbors",
        "lift_pixels": "plane_sweep_init",
        "lift_unseen": "plane_sweep_unseen",
        "leave_out_misfits": "exclude_outlier_views",
        "place_misfits": "repair_poses",
        "free_lenses": "per_view_principal_point",
        "sight_line_share": "visibility_ray_fraction",
        "average_after": "weight_averaging_start",
        "least_weight": "min_blend_weight",
        "one_order": "shared_sort_until",
        "rates": "lr",
        "near_share": "camera_clearance",
        "step_back_db": "best_checkpoint_margin_db",
    }
)
LEARNING_RATES = FormerNames({"mean_of": "mean_unit", "colour": "color", "calm_after": "scale_after"})
LOSS = FormerNames({"blocked": "free_space"})
TRACE = FormerNames({"turned_beyond": "flip_normal_cos", "order": "sort"})
DENSIFY = FormerNames(
    {
        "idle_weight": "relocate_low_weight_below",
        "idle_share": "relocate_low_weight_fraction",
        "idle_rounds": "relocate_low_weight_rounds",
    },
    {"kind": {"paper": "redisplats"}},
)
MATERIALS = FormerNames(
    {
        "parted": "depth_split",
        "reflections": "max_bounces",
        "facet_slope": "reflection_ray_slope",
        "widened": "roughness_probe_fraction",
        "ambient": "ambient_occlusion",
        "bounced": "diffuse_interreflection",
        "ambient_rays": "ambient_occlusion_rays",
        "ambient_parts": "ambient_occlusion_rebuilds",
        "normal_clip": "normal_gradient_clip",
        "start": "ray_bias",
        "leaves": "backface_cull_distance",
        "only_seen": "prune_unseen",
        "even_weight": "environment_smoothness_weight",
        "propagation": "normal_propagation",
    },
    {"recipe": {"seed": "ref_gaussian"}},
)
EVALUATE = FormerNames(
    {"background": "evaluation_background", "on": "other_dataset"}, flags={"--scene": "dataset"}
)
RELIGHT = FormerNames(
    {"by": "integrator", "depth": "max_bounces", "on": "other_dataset"},
    flags={"--scene": "dataset", "--rotate": "rotation_degrees"},
)
DEMO = FormerNames({"scene_only": "dataset_only"}, RUN.values)
DATASET = FormerNames(flags={"--scene": "dataset"})
EXTRACTION = FormerNames(
    {"depth": "depth_mode", "settle": "refine_vertices", "texture_side": "texture_size", "bounds": "box"},
    flags={"--texture": "texture_size", "--scene": "dataset", "--components": "keep_components"},
)
MATERIAL = FormerNames({"scale": "multiply"})
IMPORT = FormerNames({"file": "source"})
EXPORT = FormerNames(
    {"texture_size": "falloff_texture_size", "colour": "color"}, flags={"--texture": "falloff_texture_size"}
)
CLEAN = FormerNames(
    {"neighbours": "neighbors", "near_share": "camera_clearance"}, flags={"--near": "camera_clearance"}
)

_collected: ContextVar[list[str] | None] = ContextVar("notices of renamed settings", default=None)


def former_names(model: type[BaseModel]) -> FormerNames:
    """Return the former names of the fields of a model."""
    found = getattr(model, "former_names", NONE)
    assert isinstance(found, FormerNames)
    return found


def replace_former_names(
    models: Iterable[type[BaseModel]], values: Mapping[str, Any], prefix: str = "", source: str = ""
) -> dict[str, Any]:
    """Return nested values with settings' former names replaced by the present ones; notifies of each.

    Where a field is given by both names, the later one counts.

    Args:
        models: the models that the values may be of.
        values: values by name of field; those of sections nested.
        prefix: what users write before the names, such as ``lr.``.
        source: where they stand, such as a file, for the notice.
    """
    renamed: dict[str, str] = {}
    result = _replace_names(tuple(models), values, prefix, prefix, renamed)
    if renamed:
        notify_renamed(renamed, source)
    return result


def notify_renamed(renamed: Mapping[str, str], source: str = "") -> None:
    """Notify that names of the last version were read: a warning, or a notice where those are collected."""
    listed = list(renamed.items())[:_SHOWN]
    changes = ", ".join(f"{old} is called {new} now" for old, new in listed)
    more = f", and {len(renamed) - _SHOWN} more have new names" if len(renamed) > _SHOWN else ""
    text = f"{source}{': ' if source else ''}{changes}{more}; former names are read in this version only."
    notices = _collected.get()
    if notices is None:
        warnings.warn(text, RenamedSettingWarning, stacklevel=2)
    elif text not in notices:
        notices.append(text)


@contextmanager
def collect_notices() -> Iterator[list[str]]:
    """Yield a list to which notices go instead of being warnings, for answers that carry them."""
    notices: list[str] = []
    token = _collected.set(notices)
    try:
        yield notices
    finally:
        _collected.reset(token)


def _sections(models: Iterable[type[BaseModel]], name: str) -> tuple[type[BaseModel], ...]:
    """Return the models that the values of a field may be of."""
    fields = [model.model_fields[name] for model in models if name in model.model_fields]
    return tuple(part for field in fields for part in submodels(field.annotation))


def _replace_names(
    models: tuple[type[BaseModel], ...],
    values: Mapping[str, Any],
    before: str,
    after: str,
    renamed: dict[str, str],
) -> dict[str, Any]:
    """Return the values under their present names; adds each renamed path to ``renamed``."""
    tables = [former_names(model) for model in models]
    fields = {old: new for table in tables for old, new in table.fields.items()}
    result: dict[str, Any] = {}
    for key, value in values.items():
        name = fields.get(key, key)
        inner = _sections(models, name) if isinstance(value, Mapping) else ()
        if isinstance(value, Mapping) and inner:
            # The settings of the training need no "train." before them.
            places = (before, after) if name == "train" else (f"{before}{key}.", f"{after}{name}.")
            value = _replace_names(inner, value, *places, renamed)
            if isinstance(result.get(name), Mapping):
                value = {**result[name], **value}
        elif f"{before}{key}" != f"{after}{name}":
            renamed[f"{before}{key}"] = f"{after}{name}"
        if isinstance(value, str):
            known = {old: new for table in tables for old, new in table.values.get(name, {}).items()}
            if value in known:
                renamed[f"{before}{key}={value}"] = f"{after}{name}={known[value]}"
                value = known[value]
        result.pop(name, None)  # so that the order is that of what counts
        result[name] = value
    return result
