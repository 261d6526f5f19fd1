"""Images and videos of a stage."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.events import EventListener
from octasplat.engine.core.local_origin import is_set
from octasplat.engine.core.progress import counted_phase
from octasplat.engine.pathtracing.compile_meshes import CompiledMeshes, check_outside_glass, compile_meshes
from octasplat.engine.pathtracing.film import Film, StageImage
from octasplat.engine.pathtracing.gaussian_layers import GaussianLayers, build_gaussian_layers
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.model import Integrator, Stage
from octasplat.engine.pathtracing.stage_motion import is_moving, stage_at
from octasplat.engine.pathtracing.stage_origin import places_note, stage_about
from octasplat.engine.pathtracing.stage_placement import place_resting_meshes
from octasplat.engine.pathtracing.stage_scene import SIZE_PER_RADIUS, StageScene
from octasplat.engine.render.image_files import write_exr, write_png
from octasplat.engine.render.shots import RenderFn, Shot


@dataclass(frozen=True)
class StageRenderer:
    """A stage that is ready to be rendered.

    Attributes:
        tracer_at: returns the tracer of the stage as it is in a shot.
        settings: how to trace.
        transparent: images keep alpha in place of the background, which is black.
    """

    tracer_at: Callable[[Shot], PathTracer]
    settings: Integrator
    transparent: bool = False

    @property
    def render_fn(self) -> RenderFn:
        """Return the function that renders a shot to a file."""
        return stage_render_fn(self.tracer_at, self.settings, transparent=self.transparent)

    def preview(self, shot: Shot, output: Path, progress: EventListener) -> None:
        """Render one shot to a file, progressively.

        Raises:
            OutputError: it cannot be written.
        """
        with counted_phase("render", progress) as count:
            render_preview(
                self.tracer_at(shot),
                self.settings,
                shot,
                output,
                lambda done, of: count(0, 1, done / of),
                transparent=self.transparent,
            )
            count(1, 1)


def compile_stage(
    stage: Stage, scene: StageScene, shots: Sequence[Shot], *, transparent: bool = False
) -> StageRenderer:
    """Read and build everything of a stage, and check the cameras.

    Args:
        stage: meshes, lights, environment and how the scene takes part.
        scene: the scene that it is put into.
        shots: what is to be rendered; keys of the stage count these.
        transparent: images are to keep alpha; the scene's background is black then.

    Raises:
        OctasplatError: something of the stage cannot be used, or a camera stands in glass; where things
            move, their later places are looked at when they are rendered.
    """
    stage, moved = stage_about(stage, scene.origin_world)
    if is_set(scene.origin_world):
        subtracted = f" It was subtracted from {', '.join(moved)}." if moved else ""
        scene.note(places_note(scene.origin_world) + subtracted)
    layers = build_gaussian_layers(
        stage, scene.gaussians, scene.read_gaussians, scene.folder, scene.settings,
        size=SIZE_PER_RADIUS * scene.turntable(np.array(stage.up)).radius,
        threads=scene.threads, note=scene.note,
    )  # fmt: skip
    first = _tracer_of(
        stage_at(stage, 0), scene, layers, shots[:1] if is_moving(stage) else shots, scene.warn
    )
    if not is_moving(stage):
        return StageRenderer(lambda _shot: first, stage.integrator, transparent)
    frames = {shot.name: number for number, shot in enumerate(shots)}

    def tracer_at(shot: Shot) -> PathTracer:
        if frames[shot.name] == 0:
            return first
        # what is odd about a file was told of the first image
        return _tracer_of(stage_at(stage, frames[shot.name]), scene, layers, (shot,), _ignore)

    return StageRenderer(tracer_at, stage.integrator, transparent)


def _tracer_of(
    stage: Stage,
    scene: StageScene,
    layers: GaussianLayers | None,
    shots: Sequence[Shot],
    warn: Callable[[str], None],
) -> PathTracer:
    """Return the tracer of a stage in which nothing moves, among Gaussians that are built already."""
    stage = place_resting_meshes(
        stage,
        None if layers is None else layers.tracer,
        scene.ray_of_pixel,
        scene.folder,
        scene.origin_world,
    )
    meshes = compile_meshes(
        stage, scene.folder, threads=scene.threads, warn=warn, origin_world=scene.origin_world
    )
    check_cameras_outside_glass(meshes, shots)
    background = srgb_to_linear(scene.background_srgb.astype(np.float64))
    only_environment = stage.model_copy(update={"meshes": (), "lights": ()})
    environment = compile_meshes(only_environment, scene.folder, threads=scene.threads)
    lit = PathTracerScene(meshes, layers, background, environment)
    return PathTracer(lit, stage.integrator, threads=scene.threads)


def _ignore(_sentence: str) -> None:
    """Tell nobody."""


def stage_render_fn(
    tracer_at: Callable[[Shot], PathTracer], settings: Integrator, *, transparent: bool = False
) -> RenderFn:
    """Return the function that renders a shot of a stage to a file.

    ``.exr`` gets the linear picture before exposure and tone curve as R, G, B, and alpha as A; anything else
    gets 8-bit display values.

    Args:
        tracer_at: returns the tracer of the stage as it is in a shot.
        settings: with exposure and tone curve.
        transparent: PNG get straight colors and alpha, EXR linear ones multiplied by alpha.
    """

    def paint(shot: Shot, path: Path, part: Callable[[float], None]) -> None:
        film = tracer_at(shot).render(shot.rays(), lambda done, of: part(done / of))
        _write_film(path, film, settings, transparent)

    return paint


def check_cameras_outside_glass(meshes: CompiledMeshes, shots: Sequence[Shot]) -> None:
    """Check all cameras before anything is rendered.

    Raises:
        ConfigError: one stands in glass.
    """
    for shot in shots:
        check_outside_glass(meshes, shot.rays().origin_world, shot.name)


def render_preview(
    tracer: PathTracer,
    settings: Integrator,
    shot: Shot,
    path: Path,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
    *,
    transparent: bool = False,
) -> None:
    """Render one shot and rewrite it each time that its samples have about doubled.

    The last picture is the very one that :func:`stage_render_fn` makes, but for rounding.

    Raises:
        OutputError: the file cannot be written.
    """
    image = shot.rays()
    done = 0
    progress(0, settings.samples)
    for film in tracer.refine(image):
        _write_film(path, film, settings, transparent)
        done = max(1, min(2 * done, settings.samples))
        progress(done, settings.samples)


def _write_film(path: Path, film: Film, settings: Integrator, transparent: bool) -> None:
    image = film.image(exposure=settings.exposure, tone=settings.tone, transparent=transparent)
    write_stage_image(path, image, has_alpha=transparent)


def write_stage_image(path: Path, image: StageImage, *, has_alpha: bool = False) -> None:
    """Write an image: linear channels, alpha and compositing layers for ``.exr``, else display values.

    Args:
        path: where to.
        image: what to write.
        has_alpha: whether display values get alpha, too.

    Raises:
        OutputError: the file cannot be written.
    """
    if path.suffix.lower() == ".exr":
        layers = {name: image.rgb_linear[..., k] for k, name in enumerate("RGB")}
        write_exr(path, {**layers, "A": image.alpha, **image.layers})
    else:
        write_png(path, image.rgb_srgb, image.alpha if has_alpha else None)
