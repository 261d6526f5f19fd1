"""Pictures and films of a stage."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.colour import srgb_to_linear
from octasplat.engine.events import Listener
from octasplat.engine.light.film import StageImage
from octasplat.engine.light.integrator import LitScene, PathTracer
from octasplat.engine.light.layers import stage_layers
from octasplat.engine.light.placing import rested
from octasplat.engine.light.stage import Integrator, Stage
from octasplat.engine.light.stage_scene import SIZE_OF_RADIUS, StageScene
from octasplat.engine.light.staging import LitMeshes, refuse_inside_glass, stage_meshes
from octasplat.engine.render.images import write_exr, write_png
from octasplat.engine.render.jobs import Paint, Shot
from octasplat.engine.stages import counted_stage


@dataclass(frozen=True)
class StageRenderer:
    """A stage that is ready to be rendered.

    Attributes:
        tracer: of the stage.
        settings: how to trace.
    """

    tracer: PathTracer
    settings: Integrator

    @property
    def paint(self) -> Paint:
        """What renders a shot to a file."""
        return stage_paint(self.tracer, self.settings)

    def preview(self, shot: Shot, output: Path, progress: Listener) -> None:
        """Render one shot to a file, finer and finer.

        Raises:
            OutputError: it cannot be written.
        """
        with counted_stage("render", progress) as count:
            render_preview(self.tracer, self.settings, shot, output, lambda done, of: count(0, 1, done / of))
            count(1, 1)


def compile_stage(stage: Stage, scene: StageScene, shots: Sequence[Shot]) -> StageRenderer:
    """Read and build everything of a stage, and check the cameras.

    Args:
        stage: meshes, lights, environment and how the scene takes part.
        scene: the scene that it is put into.
        shots: what is to be rendered.

    Raises:
        OctasplatError: something of the stage cannot be used, or a camera stands in glass.
    """
    layers = stage_layers(
        stage, scene.gaussians, scene.read, scene.folder, scene.settings,
        size=SIZE_OF_RADIUS * scene.turntable(np.array(stage.up)).radius, threads=scene.threads,
    )  # fmt: skip
    stage = rested(stage, None if layers is None else layers.tracer, scene.ray_of_pixel, scene.folder)
    meshes = stage_meshes(stage, scene.folder, threads=scene.threads, say=scene.warn)
    refuse_cameras_in_glass(meshes, shots)
    background = srgb_to_linear(scene.background_srgb.astype(np.float64))
    only_environment = stage.model_copy(update={"meshes": (), "lights": ()})
    environment = stage_meshes(only_environment, scene.folder, threads=scene.threads)
    lit = LitScene(meshes, layers, background, environment)
    return StageRenderer(PathTracer(lit, stage.integrator, threads=scene.threads), stage.integrator)


def stage_paint(tracer: PathTracer, settings: Integrator) -> Paint:
    """What renders a shot of a stage to a file.

    ``.exr`` gets the linear picture before exposure and tone curve as R, G, B, and alpha as A; anything else
    gets 8-bit display values.

    Args:
        tracer: of the stage.
        settings: with exposure and tone curve.
    """

    def paint(shot: Shot, path: Path, part: Callable[[float], None]) -> None:
        film = tracer.render(shot.rays(), lambda done, of: part(done / of))
        write_stage_image(path, film.image(exposure=settings.exposure, tone=settings.tone))

    return paint


def refuse_cameras_in_glass(meshes: LitMeshes, shots: Sequence[Shot]) -> None:
    """Look at all cameras before anything is rendered.

    Raises:
        ConfigError: one stands in glass.
    """
    for shot in shots:
        refuse_inside_glass(meshes, shot.rays().origin_world, shot.name)


def render_preview(
    tracer: PathTracer,
    settings: Integrator,
    shot: Shot,
    path: Path,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> None:
    """Render one shot and write it again each time that it has become about twice as fine.

    The last picture is the very one that :func:`stage_paint` makes, but for rounding.

    Raises:
        OutputError: the file cannot be written.
    """
    image = shot.rays()
    done = 0
    progress(0, settings.samples)
    for film in tracer.refine(image):
        write_stage_image(path, film.image(exposure=settings.exposure, tone=settings.tone))
        done = max(1, min(2 * done, settings.samples))
        progress(done, settings.samples)


def write_stage_image(path: Path, image: StageImage) -> None:
    """Write a picture: linear channels, alpha and a compositor's layers for ``.exr``, else display values.

    Raises:
        OutputError: the file cannot be written.
    """
    if path.suffix.lower() == ".exr":
        layers = {name: image.rgb_linear[..., k] for k, name in enumerate("RGB")}
        write_exr(path, {**layers, "A": image.alpha, **image.layers})
    else:
        write_png(path, image.rgb_srgb)
