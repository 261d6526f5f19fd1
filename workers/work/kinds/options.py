"""Options of the job kinds, as users give them and as they are kept. Imports neither torch nor numba."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from octasplat.engine.config import ReconstructionConfig
from octasplat.engine.errors import SceneFileError
from octasplat.engine.files import exporter_for
from octasplat.engine.light.stage import Stage
from octasplat.engine.train.config import preset, with_materials
from octasplat.engine.train.preset_names import PRESETS

_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_TAKEN = frozenset(
    {"scene.ply", "config.json", "held_out.json", "views.json", "events.jsonl", "metrics.json", "report.html"}
    | {"training.json", "plan.json", "environment.hdr", "background.exr", "edits.json", "renders", "layers"}
    | {"cache", "checkpoints", "poses"}
)  # fmt: skip


def check_export_name(name: str) -> str:
    """A file name of a result, whose format is known; raises ValueError otherwise."""
    if not _FILE_NAME.fullmatch(name) or ".." in name:
        raise ValueError("name a file such as mesh.glb: letters, digits, '.', '_' and '-'")
    if name.lower() in _TAKEN:
        raise ValueError(f"{name} is the name of another result")
    try:
        exporter_for(Path(name))
    except SceneFileError as error:
        raise ValueError(str(error)) from None
    return name


ExportName = Annotated[str, AfterValidator(check_export_name)]


def read_toml(value: object) -> object:
    """What a TOML text says; anything else as it is. Raises ValueError where it is no TOML."""
    if not isinstance(value, str):
        return value
    try:
        return tomllib.loads(value)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"the stage is no TOML: {error}") from None


PhotographName = Annotated[str, Field(min_length=1, max_length=1000)]


class ReconstructOptions(ReconstructionConfig):
    """Options of ``reconstruct``: those of the engine, with names of exports that are fit to publish."""

    exports: tuple[ExportName, ...] = Field(("mesh.ply", "mesh.obj", "mesh.glb"), max_length=100)

    def config(self) -> ReconstructionConfig:
        """The engine's part."""
        return ReconstructionConfig.model_validate(self.model_dump(mode="json"))


class ExportJobOptions(BaseModel):
    """Options of ``export``.

    Attributes:
        files: files to write; their names say the formats.
        min_opacity: Gaussians fainter than this are left out.
        q: squared radius of the octagons in standard deviations; None takes that of the reconstruction.
        sh_pad_degree: Gaussian PLY: pad the harmonics with zeros up to this degree.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    files: tuple[ExportName, ...] = Field(min_length=1, max_length=100)
    min_opacity: float = Field(0.0, ge=0, lt=1)
    q: float | None = Field(None, gt=0, le=100)
    sh_pad_degree: int | None = Field(None, ge=0, le=3)


class PictureOptions(BaseModel):
    """What pictures of a scene are made.

    Attributes:
        mode: a turntable, or the views of the photographs.
        views: with ``mode`` views: which.
        format: ``mp4`` is a video of a turntable, ``png`` and ``exr`` are images.
        frames: images of one turn.
        fps: images per second of a video.
        width_px: width of a turntable's images.
        height_px: height of a turntable's images.
        fov_y_degrees: angle of a turntable's images from top to bottom; None takes that of the photographs.
        max_side: longer side of the images of views, px.
        photographs: with ``mode`` views: those of the photographs with these names, not ``views``.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: Literal["turntable", "views"] = "turntable"
    views: Literal["held-out", "train", "all"] = "held-out"
    format: Literal["mp4", "png", "exr"] = "mp4"
    frames: int = Field(120, ge=1, le=3600)
    fps: float = Field(30.0, gt=0, le=240)
    width_px: int = Field(640, ge=16, le=4096)
    height_px: int = Field(480, ge=16, le=4096)
    fov_y_degrees: float | None = Field(None, ge=1, le=170)
    max_side: int | None = Field(None, ge=16)
    photographs: tuple[PhotographName, ...] | None = Field(None, min_length=1, max_length=1000)

    @model_validator(mode="after")
    def _fits(self) -> "PictureOptions":
        if self.mode == "views" and self.format == "mp4":
            raise ValueError("views are images; choose the format png or exr")
        if self.mode == "turntable" and self.photographs is not None:
            raise ValueError("photographs are views; choose the mode views")
        return self


class RenderJobOptions(PictureOptions):
    """Options of ``render``.

    Attributes:
        background: behind the scene; None takes that of the reconstruction's evaluation.
        stage: things, lights and mirrors that the scene is rendered with, as ``docs/light.md`` describes:
            an object, or the text of a stage file. The files that it names are those of the job's
            ``files_id``.
    """

    background: Literal["black", "white"] | None = None
    stage: Annotated[Stage | None, BeforeValidator(read_toml, json_schema_input_type=Stage | str | None)] = (
        None
    )

    @model_validator(mode="after")
    def _layers_fit(self) -> "RenderJobOptions":
        if self.stage is not None and self.stage.integrator.layers and self.format != "exr":
            raise ValueError("layers are kept by EXR only; choose the format exr")
        return self


class RelightJobOptions(PictureOptions):
    """Options of ``relight``: a scene with materials in other light.

    Attributes:
        environments: equirectangular HDR or EXR images, files of the job's ``files_id``; each has its turn.
        by: ``split-sum`` is fast, as in training; ``path`` is right, by paths of light.
        samples: rays or paths a pixel; None takes 4 rays or 64 paths.
        depth: most surfaces on a path.
        rotation_degrees: turns the light about the vertical.
        clamp: radiance at which the light of the environments is cut off; None takes all of it.
        spin: turn the light once round from the first image to the last.
        background: behind the scene; None takes that of the reconstruction's evaluation.
    """

    environments: tuple[Annotated[str, Field(min_length=1, max_length=1000)], ...] = Field(
        min_length=1, max_length=20
    )
    by: Literal["split-sum", "path"] = "split-sum"
    samples: int | None = Field(None, ge=1, le=4096)
    depth: int = Field(6, ge=1, le=64)
    rotation_degrees: float = Field(0.0, ge=-360, le=360)
    clamp: float | None = Field(None, gt=0)
    spin: bool = False
    background: Literal["black", "white", "environment"] | None = None

    @property
    def rays(self) -> int:
        """Rays or paths a pixel, under all environments together."""
        return len(self.environments) * (self.samples or (64 if self.by == "path" else 4))


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
