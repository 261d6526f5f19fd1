"""The kinds that octasplat brings."""

from typing import cast

from pydantic import BaseModel

from workers.work.kinds.options import (
    EvaluateOptions,
    ExportJobOptions,
    ReconstructOptions,
    RenderJobOptions,
    resolve_reconstruction,
    revise_reconstruction,
)
from workers.work.kinds.table import JobKind, register, validated

_RUN_FILES = ("scene.ply", "config.json", "held_out.json", "views.json", "training.json", "events.jsonl")


def register_all() -> None:
    """Register them."""
    register(
        JobKind(
            name="reconstruct",
            title="Photographs to a scene, its meshes and measurements",
            needs="dataset",
            options=ReconstructOptions,
            program="workers.work.programs:reconstruct",
            stages=_reconstruction_stages,
            resolve=resolve_reconstruction,
            needs_poses=lambda options: cast(ReconstructOptions, options).poses == "given",
            settle=_settled_poses,
            revise=revise_reconstruction,
            goes_on=_same_training,
            writes=lambda options: cast(ReconstructOptions, options).exports,
            writes_at="exports",
        )
    )
    register(
        JobKind(
            name="evaluate",
            title="Measure the held-out views of a reconstruction again",
            needs="result",
            options=EvaluateOptions,
            program="workers.work.programs:evaluate",
            stages=lambda _options: ("evaluate",),
            resolve=validated(EvaluateOptions),
            source_files=_RUN_FILES,
            needs_photographs=lambda _options: True,
        )
    )
    register(
        JobKind(
            name="export",
            title="The scene of a reconstruction in other formats",
            needs="result",
            options=ExportJobOptions,
            program="workers.work.programs:export",
            stages=lambda _options: ("export",),
            resolve=validated(ExportJobOptions),
            writes=lambda options: cast(ExportJobOptions, options).files,
            writes_at="files",
            source_files=("scene.ply", "config.json"),
        )
    )
    register(
        JobKind(
            name="render",
            title="New views of the scene of a reconstruction, as a video or images",
            needs="result",
            options=RenderJobOptions,
            program="workers.work.programs:render",
            stages=lambda _options: ("render",),
            resolve=validated(RenderJobOptions),
            source_files=("scene.ply", "config.json"),
            needs_photographs=lambda _options: True,
        )
    )


def _reconstruction_stages(options: BaseModel) -> tuple[str, ...]:
    stages = ("load", "train", "evaluate", "export")
    given = cast(ReconstructOptions, options).poses == "given"
    return stages if given else ("features", "matches", "poses", *stages)


def _settled_poses(options: BaseModel, has_poses: bool) -> BaseModel:
    """Known together with the dataset, so that no job shows stages that it will not have."""
    if cast(ReconstructOptions, options).poses != "missing":
        return options
    return options.model_copy(update={"poses": "given" if has_poses else "auto"})


def _same_training(before: BaseModel, after: BaseModel) -> bool:
    """Files are written after everything else, so that others can be asked for at any time."""
    return before.model_copy(update={"exports": cast(ReconstructOptions, after).exports}) == after
