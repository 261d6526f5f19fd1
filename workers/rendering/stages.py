"""Scenes on a stage: rendered, and the first stage of a scene."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.colour import srgb_to_linear
from octasplat.engine.errors import ConfigError, OutputError
from octasplat.engine.events import Listener
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.light.integrator import LitScene, PathTracer
from octasplat.engine.light.layers import stage_layers
from octasplat.engine.light.placing import rested, scene_facts
from octasplat.engine.light.rendering import refuse_cameras_in_glass, render_preview, stage_paint
from octasplat.engine.light.stage import Integrator, Stage
from octasplat.engine.light.stage_file import StageFacts, write_first_stage
from octasplat.engine.light.staging import stage_meshes
from octasplat.engine.render.jobs import Paint, Shot, gaussian_turntable, scene_turntable
from octasplat.engine.render.paths import Turntable
from octasplat.engine.scene.model import Viewpoints
from octasplat.engine.stages import counted_stage
from octasplat.engine.trace.make import make_tracer
from octasplat.engine.trace.protocol import TraceSettings

SIZE_OF_RADIUS = 0.4
"""What the cameras look at is about this share of their distance from the axis they turn about."""
CAMERAS_ASKED = 12
"""Of so many cameras the first stage asks what they see."""


@dataclass(frozen=True)
class StagePlace:
    """The scene in which a stage is set.

    Attributes:
        gaussians: of the scene.
        settings: where rays are cut off.
        photographs: of a run, at their full size; None for a bare file.
        folder: where the stage's files are relative to.
        read: reads a file of Gaussians.
        background_srgb: display colour behind everything.
        threads: to use; 0 takes all.
        say: told in a sentence what of a mesh file is not understood.
    """

    gaussians: FlatGaussians
    settings: TraceSettings
    photographs: Viewpoints | None
    folder: Path
    read: Callable[[Path], FlatGaussians]
    background_srgb: Float32[np.ndarray, "3"]
    threads: int
    say: Callable[[str], None] = lambda _sentence: None

    def turntable(self, up_world: Float64[np.ndarray, "3"] | None = None) -> Turntable:
        """A circle round what the scene shows."""
        if self.photographs is None:
            return gaussian_turntable(self.gaussians, up_world=up_world)
        return scene_turntable(self.photographs)

    def ray_of_pixel(
        self, name: str, pixel: tuple[float, float]
    ) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """The ray through a pixel of a photograph at its full size.

        Raises:
            ConfigError: there is no such photograph, or it has no such pixel.
        """
        if self.photographs is None:
            raise ConfigError(f"{name}: a file of Gaussians has no photographs; give origin and direction.")
        names = [view.name for view in self.photographs.views]
        if name not in names:
            raise ConfigError(f"{name}: the run has no photograph of this name.")
        view = self.photographs.views[names.index(name)]
        at = np.array(pixel)
        direction = self.photographs.cameras[view.camera_index].directions_cam(at[None])[0]
        inside = (at >= 0).all() and at[0] <= view.width_px and at[1] <= view.height_px
        if not (inside and np.isfinite(direction).all()):
            raise ConfigError(f"{name}: has no pixel {pixel[0]:g}, {pixel[1]:g}.")
        return view.origin_world, direction @ view.rotation_cam_from_world


@dataclass(frozen=True)
class PaintedStage:
    """A stage that is ready to be rendered.

    Attributes:
        paint: renders a shot to a file.
        tracer: of the stage.
        settings: how to trace.
    """

    paint: Paint
    tracer: PathTracer
    settings: Integrator


def painted_stage(stage: Stage, place: StagePlace, shots: Sequence[Shot]) -> PaintedStage:
    """A stage made ready, for cameras that were looked at.

    Raises:
        OctasplatError: something of the stage cannot be used, or a camera stands in glass.
    """
    up = np.array(stage.up)
    layers = stage_layers(
        stage, place.gaussians, place.read, place.folder, place.settings,
        size=SIZE_OF_RADIUS * place.turntable(up).radius, threads=place.threads,
    )  # fmt: skip
    stage = rested(stage, None if layers is None else layers.tracer, place.ray_of_pixel, place.folder)
    meshes = stage_meshes(stage, place.folder, threads=place.threads, say=place.say)
    refuse_cameras_in_glass(meshes, shots)
    background = srgb_to_linear(place.background_srgb.astype(np.float64))
    surroundings = stage_meshes(
        stage.model_copy(update={"meshes": (), "lights": ()}), place.folder, threads=place.threads
    )
    scene = LitScene(meshes, layers, background, surroundings)
    tracer = PathTracer(scene, stage.integrator, threads=place.threads)
    return PaintedStage(stage_paint(tracer, stage.integrator), tracer, stage.integrator)


def preview_stage(stage: PaintedStage, shot: Shot, output: Path, listener: Listener) -> tuple[Path, ...]:
    """Render one shot, finer and finer; returns its file.

    Raises:
        OutputError: it cannot be written.
    """
    with counted_stage("render", listener) as count:
        render_preview(stage.tracer, stage.settings, shot, output, lambda d, of: count(0, 1, d / of))
        count(1, 1)
    return (output,)


def first_stage(place: StagePlace, up_world: Float64[np.ndarray, "3"] | None, path: Path) -> StageFacts:
    """Write a commented stage that fits a scene; returns what it was fitted to.

    Raises:
        OutputError: there is such a file already, or it cannot be written.
    """
    if path.exists():
        raise OutputError(f"{path} is there already; name another file, or remove it.")
    table = place.turntable(up_world)
    if place.photographs is None:
        cameras = table.poses(CAMERAS_ASKED)[:, :3, 3]
    else:
        views = place.photographs.views
        cameras = np.stack([view.origin_world for view in views[:: -(-len(views) // CAMERAS_ASKED)]])
    tracer = make_tracer(place.settings, threads=place.threads)
    tracer.build(place.gaussians)
    size = SIZE_OF_RADIUS * table.radius
    facts = scene_facts(place.gaussians, tracer, table.up_world, table.centre_world, size, cameras)
    try:
        write_first_stage(path, facts)
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}.") from error
    return facts
