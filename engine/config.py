"""The settings of a reconstruction, shared by the command line, ``config.json`` and the API.

Imports neither torch nor numba.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError

from octasplat.engine.errors import ConfigError
from octasplat.engine.fields import ADVANCED, BASIC, Unit
from octasplat.engine.nearest_names import did_you_mean
from octasplat.engine.train.config import TrainConfig, preset, with_materials
from octasplat.engine.train.preset_names import PresetName


class ReconstructionConfig(BaseModel):
    """Everything that decides what a reconstruction gives; the number of threads does not."""

    preset: Annotated[PresetName, BASIC] = Field(
        "standard",
        description="Where the settings of the training come from: fast is a first look, standard is "
        "better, high is better yet and takes about three times as many iterations, paper has the published "
        "settings.",
    )
    max_side: Annotated[int | None, Unit("px"), BASIC] = Field(
        None,
        ge=16,
        description="Longest side to which photographs are shrunk; None keeps their size. Set it for a quick "
        "try, or where memory is short.",
    )
    test_every: Annotated[int, Unit("views"), BASIC] = Field(
        8,
        ge=0,
        description="Every how-manieth view by name is held out to be measured; 0 holds out none, so that "
        "all are trained on.",
    )
    held_out: Annotated[tuple[str, ...] | None, ADVANCED] = Field(
        None, description="Names of the views to hold out instead."
    )
    poses: Annotated[Literal["given", "auto", "missing"], BASIC] = Field(
        "given",
        description="Where the poses of the cameras come from: given takes the COLMAP model of the dataset; "
        "auto finds the poses first, by COLMAP's features, matching and mapping; missing does so only where "
        "the dataset holds no model.",
    )
    masks: Annotated[Literal["ignore", "alpha"], ADVANCED] = Field(
        "ignore",
        description="What masks mean: ignore leaves masked pixels out of the loss, alpha takes the mask as "
        "the alpha, for objects that are cut out.",
    )
    evaluate_background: Annotated[Literal["black", "white"], ADVANCED] = Field(
        "black",
        description="What lies behind renders and photographs with alpha when they are compared.",
    )
    minutes: Annotated[float | None, Unit("minutes"), BASIC] = Field(
        None,
        ge=0.1,
        le=100_000,
        description="Time in which the training is to end, which decides its iterations and Gaussians by the "
        "pace of the machine that begins it; None leaves them to the other settings.",
    )
    exports: Annotated[tuple[str, ...], BASIC] = Field(
        ("mesh.ply", "mesh.obj", "mesh.glb"),
        description="Files to write besides scene.ply; their names say the format.",
    )
    train: TrainConfig = Field(TrainConfig(), description="The settings of the training.")


def resolve_config(
    preset_name: str = "standard",
    *,
    materials: bool = False,
    settings: Mapping[str, object] | None = None,
    assignments: Sequence[str] = (),
) -> ReconstructionConfig:
    """A configuration from a preset, top-level settings, and ``section.name=value`` assignments.

    Args:
        preset_name: one of :data:`octasplat.engine.train.preset_names.PRESETS`.
        materials: learn materials and the environment too, see
            :func:`octasplat.engine.train.config.with_materials`.
        settings: fields of :class:`ReconstructionConfig`; None values are left at their defaults.
        assignments: of any setting, values as JSON: ``rates.mean=2e-4``, which is
            ``train.rates.mean=2e-4``, or ``test_every=4``.

    Raises:
        ConfigError: an unknown name, a value out of range, or no such preset.
    """
    chosen = preset(preset_name)
    train: dict[str, Any] = (with_materials(chosen) if materials else chosen).model_dump()
    values = {key: value for key, value in (settings or {}).items() if value is not None}
    for assignment in assignments:
        name, equals, text = (part.strip() for part in assignment.partition("="))
        if not equals:
            raise ConfigError(f"--set {assignment}: write it as name=value, e.g. rates.mean=2e-4.")
        if name in ReconstructionConfig.model_fields and name not in ("preset", "train"):
            values[name] = _value(text)
        else:
            _assign(train, training_setting(name) or name, text)
    try:
        return ReconstructionConfig.model_validate({"preset": preset_name, "train": train, **values})
    except ValidationError as error:
        raise ConfigError(_first_complaint(error)) from None


def training_setting(name: str) -> str | None:
    """The setting of the training that a dotted name means; None if it means none.

    >>> training_setting("rates.mean"), training_setting("train.rates.mean"), training_setting("test_every")
    ('rates.mean', 'rates.mean', None)
    """
    inner = name.removeprefix("train.")
    return inner if inner.partition(".")[0] in TrainConfig.model_fields else None


def read_config(path: Path) -> ReconstructionConfig:
    """The configuration part of a run's ``config.json``.

    Raises:
        ConfigError: the file is missing, damaged, or of another version.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return ReconstructionConfig.model_validate(content["reconstruction"])
    except ValidationError as error:
        raise ConfigError(
            f"{path} is not a configuration of this version: {_first_complaint(error)}"
        ) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{path} cannot be read ({error}); name the folder of a finished or stopped run."
        ) from None


def _assign(target: dict[str, Any], name: str, text: str) -> None:
    *path, last = name.split(".")
    section: Any = target
    for key in path:
        section = section.get(key) if isinstance(section, dict) else None
    if not isinstance(section, dict) or (last not in section and last != "kind"):
        known = [*_names(target, ""), *(set(ReconstructionConfig.model_fields) - {"preset", "train"})]
        raise ConfigError(
            f"--set {name}: there is no such setting.{did_you_mean(name.removeprefix('train.'), known)} "
            "octasplat config list --all lists them."
        )
    value = _value(text)
    if path == ["densify"] and last == "kind" and section.get("kind") != value:
        # Another strategy has other settings: begin from its defaults.
        section.clear()
    section[last] = value


def _names(values: Mapping[str, Any], prefix: str) -> list[str]:
    """The names of all settings in nested values, with dots."""
    names: list[str] = []
    for name, value in values.items():
        names += _names(value, f"{prefix}{name}.") if isinstance(value, Mapping) else [f"{prefix}{name}"]
    return names


def _value(text: str) -> Any:
    """JSON, or else the text itself."""
    try:
        return json.loads(text)
    except ValueError:
        return text


def _first_complaint(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    return f"{where}: {first['msg']} (it is {first.get('input')!r})."
