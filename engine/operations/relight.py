"""``relight``: a scene with materials under other environments."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from octasplat.engine.core.events import EventListener, Warned, ignore_events
from octasplat.engine.operations.axes import Axis, light_up
from octasplat.engine.operations.base import Operation, never_stop
from octasplat.engine.operations.render import RenderResult
from octasplat.engine.operations.render_options import PictureOptions, PictureRequest
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import ADVANCED, InputFile, ReadPath, Spelling, Unit

if TYPE_CHECKING:
    from octasplat.engine.dataset import Viewpoints
    from octasplat.engine.operations.render_source import RenderSource
    from octasplat.engine.pathtracing.relighting.relighter import Relighter
    from octasplat.engine.render.shots import Shot
    from octasplat.engine.shading.material_settings import MaterialSettings

SPLIT_SUM_RAYS = 4
PATHS = 64
Angle = Annotated[float, Field(allow_inf_nan=False)]


class RelightOptions(PictureOptions):
    """A scene with materials under other environments, as images or a video."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.RELIGHT

    environments: Annotated[tuple[InputFile, ...], Spelling(("--environment",), metavar="MAP")] = Field(
        min_length=1,
        max_length=20,
        description="Equirectangular HDR or EXR image of the light; several are done one after another.",
    )
    integrator: Literal["split-sum", "path"] = Field(
        "split-sum",
        description="Method: split-sum is fast, as in training, with traced visibility; path is right, by "
        "paths of light.",
    )
    samples: Annotated[int | None, Unit("per pixel")] = Field(
        None,
        ge=1,
        le=65536,
        description=f"Rays or paths per pixel.  [default: {SPLIT_SUM_RAYS} rays of split-sum, {PATHS} paths]",
    )
    max_bounces: Annotated[int, Unit("surfaces")] = Field(
        6, ge=1, le=64, description="Path: most surfaces that a path of light meets."
    )
    rotation_degrees: Annotated[Angle, Unit("degrees"), Spelling(("--rotation",), metavar="DEG")] = Field(
        0.0, description="Turn the light about the vertical by this angle in degrees."
    )
    clamp: Annotated[float | None, Unit("radiance"), Spelling(metavar="MOST")] = Field(
        None,
        gt=0,
        description="Cut the light of the environments off at this radiance: fewer bright specks by paths, "
        "and weaker lamps.",
    )
    spin: bool = Field(False, description="Turn the light once round from the first image to the last.")
    up: Annotated[Axis | None, ADVANCED] = Field(
        None,
        description="The axis of the world that points up, for the light and in a file for the cameras.  "
        "[default: that of the run, of a file -y]",
    )
    background: Literal["black", "white", "transparent", "environment"] | None = Field(
        None,
        description="Behind the scene; transparent gives images alpha.  [default: that of the run's "
        "evaluation, or black]",
    )

    @property
    def samples_per_pixel(self) -> int:
        """Return the rays or paths per pixel under one environment."""
        return self.samples or (PATHS if self.integrator == "path" else SPLIT_SUM_RAYS)

    @property
    def is_single(self) -> bool:
        """Return whether there is one image, whatever the scene."""
        return super().is_single and len(self.environments) == 1  # several environments need a folder each

    @property
    def rays_across(self) -> int:
        """Return the split sum's rays across a pixel."""
        return math.isqrt(self.samples_per_pixel)

    def unused(self) -> tuple[str, ...]:
        """Return a sentence about given options that have no effect on such images."""
        sentences = super().unused()
        most = type(self).model_fields["max_bounces"].default
        if self.integrator == "split-sum" and self.max_bounces != most:
            sentences += (
                "The number of surfaces (max_bounces) goes with the integrator path and is passed over.",
            )
        # a square grid of rays
        if self.integrator == "split-sum" and self.rays_across**2 != self.samples_per_pixel:
            sentences += (
                f"Of {self.samples_per_pixel} samples split-sum takes {self.rays_across**2}, as many across "
                "a pixel as down.",
            )
        return sentences


class RelightRequest(RelightOptions, PictureRequest):
    """Show a scene with materials in other light: the folder of a run, or a file of Gaussians.

    Without other cameras: the held-out views of a run, a turntable of a file. Of several environments each
    has a folder of its name, or its turn in one video.
    """

    other_dataset: Annotated[Path | None, Spelling(metavar="FOLDER"), ReadPath()] = Field(
        None,
        description="Render the views of the photographs of another folder (images/ and sparse/0).",
    )

    @classmethod
    def _mode_of(cls, given: dict[str, Any]) -> str:
        if "other_dataset" not in given:
            return super()._mode_of(given)
        if any(name in given for name in ("views", "photographs", "camera_path", "camera")):
            raise ValueError("choose one of views, another folder, a turntable, a camera path and a camera")
        return "views"

    @model_validator(mode="after")
    def _on_fits(self) -> "RelightRequest":
        if self.other_dataset is not None and self.mode != "views":
            raise ValueError("`other_dataset` gives views; leave out other cameras")
        return self

    @property
    def _has_views(self) -> bool:
        return self.other_dataset is not None or super()._has_views


class RelightResult(RenderResult):
    """The images that were written."""


def run(
    request: RelightRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> RelightResult:
    """Relight a scene; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        ConfigError: the scene has no materials, or an environment cannot be used; or there are images of
            another render where this one is to go on.
        OctasplatError: the source cannot be read or the output not written.
        CancelledError: it was asked to stop.
    """
    from octasplat.engine.core.progress import stop_when_asked
    from octasplat.engine.gaussians.materials import require_materials
    from octasplat.engine.operations.render_source import (
        picture_output,
        read_render_source,
        requested_cameras,
    )
    from octasplat.engine.pathtracing.relighting.relit_images import (
        RelitRenderFn,
        lit_shots,
        read_environments,
    )
    from octasplat.engine.render.render_digest import render_digest
    from octasplat.engine.render.shots import camera_shots
    from octasplat.engine.runs.config import read_config
    from octasplat.engine.runs.run_folder import CONFIG, SCENE, is_full_run, is_run
    from octasplat.engine.shading.recipes import material_shading

    report = stop_when_asked(progress, should_stop)
    for sentence in request.unused():
        report(Warned(sentence))
    of_run = is_full_run(request.source)
    environments = read_environments(
        request.environments, request.clamp, lambda sentence: report(Warned(sentence))
    )
    source = read_render_source(request.source, report, dataset=request.dataset, max_side=request.max_side)
    scene_file = request.source / SCENE if is_run(request.source) else request.source
    require_materials(source.gaussians, scene_file)
    learnt = read_config(request.source / CONFIG).train.materials if of_run else None
    if learnt is not None and material_shading(learnt.recipe).albedo_holds_light:
        report(
            Warned(
                f"{request.source} was trained with materials.recipe={learnt.recipe}: base colors of what "
                "does not reflect hold the light of the photographs."
            )
        )
    up = light_up(request.source, request.up)
    cameras = None if request.other_dataset is not None else requested_cameras(request, source)
    views, shots = _selected_views(request, source) if cameras is None else (None, camera_shots(cameras))
    lightings = lit_shots(list(environments), shots, request.rotation_degrees, spin=request.spin)
    output = picture_output(
        "relight", request, tuple(lightings), [request.other_dataset, *request.environments]
    )
    background = request.background or source.background
    # before the relighter is made, which takes long
    finished = output.finished_images(
        render_digest(
            "relight",
            source.gaussians,
            source.settings,
            list(environments),
            list(environments.values()),
            up,
            cameras,
            views,
            source.near_world,
            len(shots),
            request.integrator,
            request.samples_per_pixel,
            request.max_bounces,
            request.rotation_degrees,
            request.spin,
            background,
            request.format,
            *output.numbered(shots, counts=request.spin and cameras is None),
        )
    )
    relighter = _make_relighter(request, source, learnt, threads)
    paint = RelitRenderFn(relighter, environments, up, background, lightings)
    files = output.write(tuple(lightings), paint, finished, report)
    return RelightResult(files=files, folder=output.folder, images=len(lightings))


def _selected_views(request: RelightRequest, source: "RenderSource") -> "tuple[Viewpoints, tuple[Shot, ...]]":
    """Return the views of photographs that are asked for, and the cameras of all photographs among them."""
    import numpy as np

    from octasplat.engine.dataset import Viewpoints, load_dataset_model
    from octasplat.engine.operations.render_source import requested_views
    from octasplat.engine.render.shots import view_shots

    if request.other_dataset is None:
        shots = requested_views(request, source)
        assert source.viewpoints is not None, "views were asked for"
        return Viewpoints(source.viewpoints.views, source.viewpoints.cameras), shots
    max_side = request.max_side or source.max_side
    others = load_dataset_model(
        request.other_dataset,
        max_side=max_side,
        min_views=1,
        for_training=False,
        origin_world=source.origin_world,
    )
    shots = view_shots(others, np.arange(len(others.views)), source.near_world)
    return Viewpoints(others.views, others.cameras), shots


def _make_relighter(
    request: RelightRequest, source: "RenderSource", learnt: "MaterialSettings | None", threads: int
) -> "Relighter":
    from octasplat.engine.pathtracing.relighting.path_relighter import PathRelighter
    from octasplat.engine.pathtracing.relighting.split_sum_relighter import SplitSumRelighter
    from octasplat.engine.pathtracing.stage.model import Integrator

    if request.integrator == "split-sum":
        return SplitSumRelighter(
            source.gaussians, source.settings, learnt, extent_world=source.extent_world,
            rays_across_pixel=request.rays_across, threads=threads,
        )  # fmt: skip
    integrator = Integrator(
        samples=request.samples_per_pixel,
        max_depth=request.max_bounces,
        roulette_depth=request.max_bounces,
    )
    return PathRelighter(source.gaussians, source.settings, integrator, threads=threads)


OPERATION = Operation(
    "relight", "Show a scene with materials in other light.", RelightRequest, RelightOptions, run
)
