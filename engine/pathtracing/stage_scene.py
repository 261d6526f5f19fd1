"""The scene for a stage, and the first stage of a scene."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin, is_set
from octasplat.engine.dataset.model import Viewpoints
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pathtracing.stage.stage_template import StageLayout
from octasplat.engine.pathtracing.stage_origin import places_note
from octasplat.engine.render.pose_paths import Turntable
from octasplat.engine.render.shots import gaussian_turntable, turntable_of_views
from octasplat.engine.trace.protocol import TraceSettings

SIZE_PER_RADIUS = 0.4
"""What the cameras look at is about this share of their distance from the axis they turn about."""
LAYOUT_CAMERAS = 12
"""The first stage asks what so many of the cameras see."""


@dataclass(frozen=True)
class StageScene:
    """The scene for a stage.

    Attributes:
        gaussians: of the scene.
        settings: where rays are cut off.
        photographs: of a run, at their full size; None for a file.
        folder: where the names of the stage's files are relative to.
        read_gaussians: reads a file of Gaussians.
        background_srgb: display color behind everything.
        threads: to use; 0 takes all.
        warn: called with a sentence on what of a mesh file is not understood.
        note: called with a sentence on which origin places are.
        origin_world: local origin of the Gaussians and photographs, see
            :mod:`octasplat.engine.core.local_origin`.
    """

    gaussians: FlatGaussians
    settings: TraceSettings
    photographs: Viewpoints | None
    folder: Path
    read_gaussians: Callable[[Path], FlatGaussians]
    background_srgb: Float32[np.ndarray, "3"]
    threads: int
    warn: Callable[[str], None] = lambda _sentence: None
    note: Callable[[str], None] = lambda _sentence: None
    origin_world: Origin = NO_ORIGIN

    def turntable(self, up_world: Float64[np.ndarray, "3"] | None = None) -> Turntable:
        """Return a circle around the visible scene."""
        if self.photographs is None:
            return gaussian_turntable(self.gaussians, up_world=up_world)
        return turntable_of_views(self.photographs, self.gaussians)

    def ray_of_pixel(
        self, name: str, pixel: tuple[float, float]
    ) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]:
        """Return origin and direction of the ray through a pixel of a photograph at its full size.

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
        # rotation_cam_from_world maps world to camera: from the right it is the inverse
        return view.origin_world, direction @ view.rotation_cam_from_world


def first_stage_layout(scene: StageScene, up_world: Float64[np.ndarray, "3"] | None) -> StageLayout:
    """Return the layout of the scene's first stage: up, floor, size and light.

    Args:
        scene: the scene.
        up_world: the direction that the user says is up; None for that of the photographs, or -y.

    Raises:
        ConfigError: the cameras of the photographs share no up direction.
    """
    # here, as every stage imports this module, and few of them are the first
    from octasplat.engine.pathtracing.stage_layout import estimate_stage_layout
    from octasplat.engine.trace.factory import make_tracer

    table = scene.turntable(up_world)
    if scene.photographs is None:
        cameras = table.poses(LAYOUT_CAMERAS)[:, :3, 3]
    else:
        views = scene.photographs.views
        cameras = np.stack([view.origin_world for view in views[:: -(-len(views) // LAYOUT_CAMERAS)]])
    tracer = make_tracer(scene.settings, threads=scene.threads, is_used_once=True)
    tracer.build(scene.gaussians)
    size = SIZE_PER_RADIUS * table.radius
    found = estimate_stage_layout(
        gaussians=scene.gaussians,
        tracer=tracer,
        up_world=table.up_world,
        centre_world=table.centre_world,
        size=size,
        cameras_world=cameras,
    )
    return replace(found, note=places_note(scene.origin_world) if is_set(scene.origin_world) else "")
