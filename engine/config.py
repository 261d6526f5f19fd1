"""The settings of a reconstruction, shared by the command line, ``config.json`` and later the API.

Imports neither torch nor numba.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from octasplat.engine.errors import ConfigError
from octasplat.engine.train.config import TrainConfig, preset, with_materials
from octasplat.engine.train.preset_names import PresetName


class ReconstructionConfig(BaseModel):
    """Everything that decides what a reconstruction gives; the number of threads does not.

    Attributes:
        preset: where the training defaults come from.
        max_side: cap on the longer side of the photographs, px; None keeps their size.
        test_every: every how-manieth view by name is held out; 0 holds out none.
        held_out: names of the views to hold out instead.
        poses: ``given`` takes the COLMAP model of the scene; ``auto`` finds the poses first, by COLMAP's
            features, matching and mapping; ``missing`` does so only where the scene holds no model.
        masks: ``ignore`` leaves masked pixels out of the loss, ``alpha`` takes the mask as the alpha.
        evaluate_background: what lies behind renders and photographs with alpha when they are compared.
        minutes: the training is to end within so many, which decides its iterations and Gaussians by the pace
            of the machine that begins it; None leaves them to ``train``.
        exports: files to write besides ``scene.ply``; their names say the format.
        train: the training, fully resolved.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    preset: PresetName = "standard"
    max_side: int | None = Field(None, ge=16)
    test_every: int = Field(8, ge=0)
    held_out: tuple[str, ...] | None = None
    poses: Literal["given", "auto", "missing"] = "given"
    masks: Literal["ignore", "alpha"] = "ignore"
    evaluate_background: Literal["black", "white"] = "black"
    minutes: float | None = Field(None, ge=0.1, le=100_000)
    exports: tuple[str, ...] = ("mesh.ply", "mesh.obj", "mesh.glb")
    train: TrainConfig = TrainConfig()


def resolve_config(
    preset_name: str = "standard",
    *,
    materials: bool = False,
    settings: Mapping[str, object] | None = None,
    assignments: Sequence[str] = (),
) -> ReconstructionConfig:
    """A configuration from a preset, top-level settings, and ``section.name=value`` assignments.

    Args:
        preset_name: ``fast``, ``standard`` or ``paper``.
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
        raise ConfigError(
            f"--set {name}: there is no such setting; see config.json of any run for all names."
        )
    value = _value(text)
    if path == ["densify"] and last == "kind" and section.get("kind") != value:
        # Another strategy has other settings: begin from its defaults.
        section.clear()
    section[last] = value


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
