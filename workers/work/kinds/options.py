"""Options of the job kinds, as users give them and as they are kept. Imports neither torch nor numba."""

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from octasplat.engine.config import ReconstructionConfig
from octasplat.engine.files.result_names import ExportName
from octasplat.engine.train.config import preset, with_materials
from octasplat.engine.train.preset_names import PRESETS


class ReconstructOptions(ReconstructionConfig):
    """Options of ``reconstruct``: those of the engine, with names of exports that are fit to publish."""

    exports: tuple[ExportName, ...] = Field(("mesh.ply", "mesh.obj", "mesh.glb"), max_length=100)

    def config(self) -> ReconstructionConfig:
        """The engine's part."""
        return ReconstructionConfig.model_validate(self.model_dump(mode="json"))


def _learns_materials(train: object) -> bool:
    materials = train.get("materials") if isinstance(train, Mapping) else None
    return isinstance(materials, Mapping) and materials.get("learn") is True


def resolve_reconstruction(asked: Mapping[str, Any]) -> ReconstructOptions:
    """Complete options: the preset's training settings with what was asked for on top.

    Raises:
        ValidationError: an unknown name or a value out of range.
    """
    name = asked.get("preset", "standard")
    known = name in PRESETS
    train = asked.get("train")
    base: dict[str, Any] = {}
    if known:
        chosen = preset(str(name))
        base = (with_materials(chosen) if _learns_materials(train) else chosen).model_dump(mode="json")
    merged = _merged(base, train) if isinstance(train, Mapping) else base if train is None else train
    return ReconstructOptions.model_validate({**asked, "train": merged})


def revise_reconstruction(before: Mapping[str, Any], changes: Mapping[str, Any]) -> ReconstructOptions:
    """The options of a job with changes; another preset brings its own training settings.

    Raises:
        ValidationError: an unknown name or a value out of range.
    """
    another = changes.get("preset", before.get("preset")) != before.get("preset")
    kept = {key: value for key, value in before.items() if key != "train"}
    if another or not isinstance(changes.get("train", {}), Mapping):
        return resolve_reconstruction({**kept, **changes})
    train = _merged(before.get("train", {}), changes.get("train", {}))
    return resolve_reconstruction({**kept, **changes, "train": train})


def _merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with the values of ``over``, section by section; a section of another kind begins anew."""
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        merged[key] = value
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            same_kind = value.get("kind", old.get("kind")) == old.get("kind")
            merged[key] = _merged(old, value) if same_kind else value
    return merged
