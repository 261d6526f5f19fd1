"""``render``: new views of a scene, plain or on a stage."""

import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field, model_validator

from octasplat.engine.core.events import EventListener, Noted, Warned, ignore_events
from octasplat.engine.operations.base import Operation, Result, never_stop
from octasplat.engine.operations.render_options import (
    UP_OF_RUN_UNUSED,
    PictureOptions,
    PictureRequest,
    check_layers,
)
from octasplat.engine.pathtracing.stage.model import Stage
from octasplat.engine.pathtracing.stage.stage_file import read_stage, referenced_files, toml_complaint
from octasplat.engine.pathtracing.stage.text_bounds import check_stage_text
from octasplat.engine.settings.fields import ADVANCED, ReadPath, Spelling

if TYPE_CHECKING:
    from octasplat.engine.operations.render_source import RenderSource
    from octasplat.engine.render.output import RenderOutput
    from octasplat.engine.render.pinhole_camera import PinholeCamera
    from octasplat.engine.render.shots import Shot

PREVIEW_SIDE_PX = 480
STAGE_LACKS_BACKGROUND = (
    "The background that was learnt is left out on a stage; to show it, and to be lit by it, name the run's "
    "background.exr as the stage's environment, with up = [0, -1, 0] there."
)
STAGE_IS_OPAQUE = (
    "The environment of the stage is seen behind everything, so that no pixel is transparent; with visible = "
    "false it lights the scene alone."
)
STAGE_LACKS_MATERIALS = (
    "The scene's materials are left out on this stage, and its harmonics shown, which have no sharp "
    'reflections; light = "relit" of [[gaussians]] shows materials in the light of the stage, such as the '
    "environment.exr of a run (whose up is its materials.up_world): octasplat stage init writes both where "
    "materials can be lit."
)
EMISSIVE_TAKES_NO_LIGHT = (
    'takes no light of it: all Gaussians of this stage have light = "emissive", so that it lights meshes '
    'alone; light = "shadowed" of [[gaussians]] adds its light to them, "relit" lights them by it alone.'
)


def parse_stage_text(value: object) -> object:
    """Return the content of a TOML text; any other value as it is.

    Raises:
        ValueError: invalid TOML, or a text beyond the bounds of :func:`check_stage_text`.
    """
    if not isinstance(value, str):
        return value
    check_stage_text(value)
    try:
        return tomllib.loads(value)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ValueError(f"the stage is no TOML: {toml_complaint(value, error)}") from None


class RenderOptions(PictureOptions):
    """New views of a scene, as images or a video."""

    background: Literal["black", "white", "transparent"] | None = Field(
        None,
        description="Behind the scene; transparent gives images alpha.  [default: what the run has learnt, "
        "or that of its evaluation; of a file black]",
    )
    stage: Annotated[
        Stage | None,
        BeforeValidator(parse_stage_text, json_schema_input_type=Stage | str | None),
        Spelling(hidden=True),
    ] = Field(
        None,
        description="Meshes, lights and materials that the scene is rendered with, as docs/light.md "
        "describes: an object, or the text of a stage file. The files that it names are those of the job's "
        "files_id.",
    )
    shading: Annotated[Literal["materials", "harmonics"] | None, ADVANCED] = Field(
        None,
        description="Colors of the Gaussians: their materials in the light that the run has learnt, or their "
        "harmonics, which are faster and show no sharp reflections.  [default: materials, of a run that has "
        "them]",
    )
    preview: Annotated[bool, ADVANCED] = Field(
        False, description="Stage: render the first image only, to one file, finer and finer."
    )
    layers: Annotated[bool, ADVANCED] = Field(
        False, description="Stage: write EXR files with background, shadow and things, for a compositor."
    )
    denoise: Annotated[bool, ADVANCED] = Field(
        False, description="Stage: remove the noise of the light from the images; needs the extra denoise."
    )

    @model_validator(mode="after")
    def _stage_fits(self) -> "RenderOptions":
        if self.stage is None:
            for name in ("preview", "layers", "denoise"):
                if getattr(self, name):
                    raise ValueError(f"`{name}` goes with `stage`")
            return self
        if self.shading is not None:
            raise ValueError("`shading` goes without `stage`, in which `light` says how Gaussians are lit")
        if (self.layers or self.stage.integrator.layers) and self.format != "exr":
            raise ValueError("layers are kept by EXR only; choose the format exr")
        if self.preview and self.format == "mp4":
            raise ValueError("a preview is one image; choose the format png or exr (name an image)")
        return self

    @property
    def staged(self) -> Stage | None:
        """Return the stage, with its integrator's settings replaced by the options."""
        if self.stage is None:
            return None
        requested = {name: True for name in ("layers", "denoise") if getattr(self, name)}
        return self.stage.model_copy(
            update={"integrator": self.stage.integrator.model_copy(update=requested)}
        )


class RenderRequest(RenderOptions, PictureRequest):
    """Render new views of a scene, the folder of a run or a file of Gaussians in any splat format.

    Without other cameras: the held-out views of a run, a turntable of a file. Ctrl-C stops after the image
    under way has come to a safe point; the same command with --resume goes on.
    """

    stage_file: Annotated[Path | None, Spelling(("--stage",), metavar="STAGE.toml"), ReadPath()] = Field(
        None,
        description="Render with the meshes, lights and materials of a stage, which docs/light.md describes.",
    )
    stage_folder: Annotated[Path, Spelling(hidden=True)] = Field(
        Path(),
        description="Where the names of the stage's files are relative to.  [default: the folder of the "
        "stage file]",
    )

    @model_validator(mode="before")
    @classmethod
    def _read_stage(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        given = dict(values)
        if given.get("stage_file") is not None and given.get("stage") is None:
            # the stage's files are named relative to its own file
            given["stage"] = read_stage(Path(given["stage_file"]))
            given["stage_folder"] = Path(given["stage_file"]).parent
        stage = given.get("stage")
        layers = given.get("layers") or (isinstance(stage, Stage) and stage.integrator.layers)
        # layers need EXR, which the output's name may not say
        if layers and stage is not None and "output" in given and given.get("format") is None:
            check_layers(Path(given["output"]))
            given["format"] = "exr"
        return given

    @model_validator(mode="after")
    def _preview_fits(self) -> "RenderRequest":
        if self.preview and not self._is_image:
            raise ValueError("a preview is one .png or .exr; name it as `output`")
        return self

    @property
    def _needs_pattern(self) -> bool:
        return self._is_image and not self.preview


class RenderResult(Result):
    """The images that were written.

    Attributes:
        images: number of images that were rendered, those of a video among them.
    """

    images: int

    def lines(self) -> tuple[str, ...]:
        """Return a sentence that says where they are."""
        more = f" and {len(self.files) - 1} more." if len(self.files) > 1 else "."
        return (f"Wrote {self.files[0]}{more}",)


class _RenderPlan(NamedTuple):
    """Source, cameras and output of a render; ``cameras`` None stands for views of the photographs."""

    request: RenderRequest
    source: "RenderSource"
    cameras: "tuple[PinholeCamera, ...] | None"
    shots: "tuple[Shot, ...]"
    output: "RenderOutput"


def run(
    request: RenderRequest,
    *,
    progress: EventListener = ignore_events,
    should_stop: Callable[[], bool] = never_stop,
    threads: int = 0,
) -> RenderResult:
    """Render new views; see :class:`octasplat.engine.operations.base.Run`.

    Raises:
        OctasplatError: the scene or the stage cannot be used, or the output not written; or there are images
            of another render where this one is to go on.
        CancelledError: it was asked to stop.
    """
    from octasplat.engine.core.progress import stop_when_asked
    from octasplat.engine.operations.render_source import (
        picture_output,
        read_render_source,
        requested_cameras,
        requested_views,
    )
    from octasplat.engine.render.shots import camera_shots

    message = "Stopped; the preview is as fine as it was." if request.preview else None
    report = stop_when_asked(progress, should_stop, message)
    for unused in request.unused():
        report(Warned(unused))
    # a preview is small by default
    max_side = request.max_side or (PREVIEW_SIDE_PX if request.preview else None)
    source = read_render_source(
        request.source,
        report,
        dataset=request.dataset,
        max_side=max_side,
        full_size=request.stage is not None,
        # a stage says itself how Gaussians are lit
        shading=request.shading if request.stage is None else "harmonics",
    )
    if request.up is not None and source.viewpoints is not None:
        report(Warned(UP_OF_RUN_UNUSED))
    cameras = requested_cameras(request, source, None if request.stage is None else request.stage.up)
    shots = requested_views(request, source) if cameras is None else camera_shots(cameras)
    written = shots[:1] if request.preview else shots
    output = picture_output("render", request, written, [request.stage_file, *_stage_files(request)])
    render = _render_plain if request.stage is None else _render_on_stage
    files = render(_RenderPlan(request, source, cameras, shots, output), report, threads)
    return RenderResult(files=files, folder=output.folder, images=len(written))


def _stage_files(request: RenderRequest) -> list[Path]:
    """Return the files that the stage refers to."""
    if request.stage is None:
        return []
    return [request.stage_folder / name for _, name in referenced_files(request.stage)]


def _render_plain(plan: _RenderPlan, progress: EventListener, threads: int) -> tuple[Path, ...]:
    request, source, cameras, shots, output = plan
    from octasplat.engine.render.render_digest import render_digest
    from octasplat.engine.render.renderer import background_color
    from octasplat.engine.render.shots import scene_render_fn
    from octasplat.engine.shading.plain import PLAIN_SHADING
    from octasplat.engine.trace.factory import make_tracer

    # transparent pictures are rendered over black, and alpha is kept
    transparent = request.background == "transparent"
    background = background_color("black" if transparent else request.background or source.background)
    learnt = None if request.background else source.learnt  # another color was asked for, or alpha
    materials, residual = source.materials, source.residual
    views = None if cameras is not None else (source.viewpoints, source.near_world)
    finished = output.finished_images(
        render_digest(
            source.gaussians, source.settings, background, transparent, cameras, None, views,
            source.trained_rad, None if learnt is None else learnt.rgb_srgb, *output.numbered(shots),
            *(() if materials is None else (materials.settings, materials.light.radiance_linear)),
            *(() if residual is None else (residual.residual_sh,)),
        )
    )  # fmt: skip
    shading = residual or materials or learnt or PLAIN_SHADING
    tracer = make_tracer(source.settings, threads=threads, build_quality=2)
    tracer.build(source.gaussians, shading.features(source.gaussians))
    paint = scene_render_fn(
        tracer,
        background,
        transparent=transparent,
        trained_rad=source.trained_rad,
        shading=shading,
        gives_radiance=materials is not None,
    )
    return output.write(shots, paint, finished, progress)


def _render_on_stage(plan: _RenderPlan, progress: EventListener, threads: int) -> tuple[Path, ...]:
    request, source, cameras, shots, output = plan
    from octasplat.engine.gaussians.materials import has_materials
    from octasplat.engine.operations.render_source import stage_scene
    from octasplat.engine.operations.stage_light import lit_stage
    from octasplat.engine.pathtracing.stage.stage_file import stage_identity
    from octasplat.engine.pathtracing.stage_motion import is_moving
    from octasplat.engine.pathtracing.stage_rendering import compile_stage
    from octasplat.engine.render.render_digest import render_digest
    from octasplat.engine.render.renderer import background_color

    given = request.staged
    assert given is not None
    if source.learnt is not None and request.background is None and given.environment is None:
        progress(Warned(STAGE_LACKS_BACKGROUND))
    named = {part.light for part in given.gaussians if part.file is None}
    if has_materials(source.gaussians) and named - {"relit", None}:
        progress(Noted(STAGE_LACKS_MATERIALS))
    lit = lit_stage(given, request.source, source.gaussians, lambda text: progress(Noted(text)))
    stage = lit.stage
    for sentence in _ignored_light(stage):
        progress(Warned(sentence))
    transparent = request.background == "transparent"
    if transparent and stage.environment is not None and stage.environment.visible:
        progress(Warned(STAGE_IS_OPAQUE))
    background = background_color("black" if transparent else request.background or source.background)
    scene = stage_scene(source, request.stage_folder, background, progress, threads=threads)
    if request.preview:
        renderer = compile_stage(stage, scene, shots, transparent=transparent)
        renderer.preview(shots[0], request.output, progress)
        return (request.output,)
    views = None if cameras is not None else (source.viewpoints, source.near_world)
    # what decides how images look; the output's place does not
    finished = output.finished_images(
        render_digest(
            source.gaussians, source.settings, background, transparent, cameras,
            stage_identity(given, request.stage_folder), views, scene.photographs, *lit.identity,
            *output.numbered(shots, counts=is_moving(stage) and cameras is None),
        )
    )  # fmt: skip
    renderer = compile_stage(stage, scene, shots, transparent=transparent)
    return output.write(shots, renderer.render_fn, finished, progress)


def _ignored_light(stage: Stage) -> Iterator[str]:
    """Return a sentence on each lamp that is to add its light to Gaussians, none of which take light."""
    if not stage.gaussians or any(scene.light != "emissive" for scene in stage.gaussians):
        return
    for number, light in enumerate(stage.lights):
        if light.adds_light:
            yield f"lights[{number}].adds_light: the scene {EMISSIVE_TAKES_NO_LIGHT}"


OPERATION = Operation(
    "render", "Render new views of a scene as images or a video.", RenderRequest, RenderOptions, run
)
