"""The kinds that octasplat brings."""

from collections.abc import Iterator, Sequence
from typing import cast

from pydantic import BaseModel

from octasplat.engine.light.stage_file import named_files
from octasplat.engine.train.config import MOST_PLANNED_ITERATIONS, iteration_count, most_gaussians
from octasplat.workers.records.sizes import Sizes
from octasplat.workers.work.kinds.demands import Demand
from octasplat.workers.work.kinds.estimates import (
    estimate_reconstruction,
    estimate_relight,
    estimate_render,
    image_bytes,
    reconstruction_bytes,
    rendered_pixels,
    training_pixels,
)
from octasplat.workers.work.kinds.options import (
    EvaluateOptions,
    ExportJobOptions,
    MaterialJobOptions,
    ReconstructOptions,
    RelightJobOptions,
    RenderJobOptions,
    resolve_reconstruction,
    revise_reconstruction,
)
from octasplat.workers.work.kinds.table import JobKind, register, validated

_RUN_FILES = ("scene.ply", "config.json", "held_out.json", "views.json", "training.json", "events.jsonl")
_LIGHT = "environment.hdr"
"""What results with materials have, and no others."""
_BACKGROUND = "background.exr"
"""What results with a learnt background have, and no others."""


def register_all() -> None:
    """Register them."""
    register(
        JobKind(
            name="reconstruct",
            title="Photographs to a scene, its meshes and measurements",
            needs="dataset",
            options=ReconstructOptions,
            program="octasplat.workers.work.programs:reconstruct",
            stages=_reconstruction_stages,
            resolve=resolve_reconstruction,
            needs_poses=lambda options: cast(ReconstructOptions, options).poses == "given",
            settle=_settled_poses,
            revise=revise_reconstruction,
            goes_on=_same_training,
            writes=lambda options: cast(ReconstructOptions, options).exports,
            writes_at="exports",
            demands=_reconstruction_demands,
            estimate=lambda options, sizes, cores: estimate_reconstruction(
                cast(ReconstructOptions, options), sizes, cores
            ),
        )
    )
    register(
        JobKind(
            name="evaluate",
            title="Measure views of a reconstruction: those held out again, or other photographs",
            needs="result",
            options=EvaluateOptions,
            program="octasplat.workers.work.programs:evaluate",
            stages=lambda _options: ("evaluate",),
            resolve=validated(EvaluateOptions),
            source_files=(*_RUN_FILES, _LIGHT, _BACKGROUND, "edits.json"),
            needs_photographs=lambda _options: True,
            on_others=lambda options: options.model_copy(update={"all_views": True}),
        )
    )
    register(
        JobKind(
            name="export",
            title="The scene of a reconstruction in other formats",
            needs="result",
            options=ExportJobOptions,
            program="octasplat.workers.work.programs:export",
            stages=lambda _options: ("export",),
            resolve=validated(ExportJobOptions),
            writes=lambda options: cast(ExportJobOptions, options).files,
            writes_at="files",
            demands=lambda options, _sizes: (
                Demand("files", "exports", len(cast(ExportJobOptions, options).files)),
            ),
            source_files=("scene.ply", "config.json"),
        )
    )
    register(
        JobKind(
            name="render",
            title="New views of the scene of a reconstruction, as a video or images",
            needs="result",
            options=RenderJobOptions,
            program="octasplat.workers.work.programs:render",
            stages=lambda _options: ("render",),
            resolve=validated(RenderJobOptions),
            demands=_render_demands,
            estimate=lambda options, sizes, cores: estimate_render(
                cast(RenderJobOptions, options), sizes, cores
            ),
            names_files=_files_of_stage,
            source_files=(*_RUN_FILES[:4], _BACKGROUND),
        )
    )
    register(
        JobKind(
            name="relight",
            title="The scene of a reconstruction with materials in other light",
            needs="result",
            options=RelightJobOptions,
            program="octasplat.workers.work.programs:relight",
            stages=lambda _options: ("render",),
            resolve=validated(RelightJobOptions),
            demands=_relight_demands,
            estimate=lambda options, sizes, cores: estimate_relight(
                cast(RelightJobOptions, options), sizes, cores
            ),
            names_files=lambda options: (
                (f"environments.{place}", name)
                for place, name in enumerate(cast(RelightJobOptions, options).environments)
            ),
            source_files=(_LIGHT, *_RUN_FILES[:4]),
        )
    )
    register(
        JobKind(
            name="material",
            title="The scene of a reconstruction with other materials",
            needs="result",
            options=MaterialJobOptions,
            program="octasplat.workers.work.programs:material",
            stages=lambda _options: ("edit",),
            resolve=validated(MaterialJobOptions),
            source_files=(_LIGHT, *_RUN_FILES, "edits.json"),
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


def _reconstruction_demands(options: BaseModel, sizes: Sequence[Sizes]) -> tuple[Demand, ...]:
    asked = cast(ReconstructOptions, options)
    train = asked.train
    pixels = training_pixels(asked, sizes)
    gaussians = most_gaussians(train, pixels)
    iterations = MOST_PLANNED_ITERATIONS if asked.minutes else iteration_count(train, pixels)
    return (
        Demand("train.iterations", "iterations", iterations),
        Demand("train.max_gaussians", "gaussians", gaussians),
        Demand("train.rays", "rays", train.rays),
        Demand("train.probe_rays", "rays", train.probe_rays),
        Demand("train.window_rays", "rays", train.window_rays),
        Demand("train.patch_side", "rays", train.patch_side**2),
        Demand("max_side", "side_px", asked.max_side or 0),
        Demand("exports", "exports", len(asked.exports)),
        Demand("max_side", "workspace_bytes", reconstruction_bytes(asked, sizes)),
    )


def _render_demands(options: BaseModel, sizes: Sequence[Sizes]) -> tuple[Demand, ...]:
    asked = cast(RenderJobOptions, options)
    path = "frames" if asked.mode == "turntable" else "max_side"
    pixels = rendered_pixels(asked, sizes)
    always = (
        Demand(path, "render_pixels", pixels),
        Demand("format", "workspace_bytes", image_bytes(asked, sizes)),
    )
    if asked.stage is None:
        return always
    return (
        *always,
        Demand("stage.integrator.samples", "render_paths", pixels * asked.stage.integrator.samples),
    )


def _relight_demands(options: BaseModel, sizes: Sequence[Sizes]) -> tuple[Demand, ...]:
    asked = cast(RelightJobOptions, options)
    path = "frames" if asked.mode == "turntable" else "max_side"
    pixels = rendered_pixels(asked, sizes)
    return (
        Demand(path, "render_pixels", pixels * len(asked.environments)),
        Demand("format", "workspace_bytes", image_bytes(asked, sizes, len(asked.environments))),
        Demand("samples", "render_paths", pixels * asked.rays),
    )


def _files_of_stage(options: BaseModel) -> Iterator[tuple[str, str]]:
    stage = cast(RenderJobOptions, options).stage
    for key, name in named_files(stage) if stage is not None else ():
        yield f"stage.{key.replace('[', '.').replace(']', '')}", name


def _same_training(before: BaseModel, after: BaseModel) -> bool:
    """Files are written after everything else, so that others can be asked for at any time."""
    return before.model_copy(update={"exports": cast(ReconstructOptions, after).exports}) == after
