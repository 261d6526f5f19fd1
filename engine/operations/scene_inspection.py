"""Facts on a scene in a file or a run, and a small picture of it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.evaluate.scene_statistics import (
    HitStatistics,
    SceneStatistics,
    hit_statistics,
    scene_statistics,
)
from octasplat.engine.pathtracing.stage_scene import StageScene
from octasplat.engine.render.renderer import render_rays
from octasplat.engine.render.shots import turntable_cameras
from octasplat.engine.surface.depth_cameras import photograph_cameras
from octasplat.engine.trace.factory import make_tracer

PICTURE_SIDE_PX = 160


@dataclass(frozen=True)
class SceneInspection:
    """Facts on a scene.

    Attributes:
        scene: on its Gaussians.
        hits: on the rays of the picture.
        up_world: the direction that points up; known of a run, a guess of a file.
        picture_srgb: display values, from the first photograph's place of a run.
        photographs: how many; None of a file.
    """

    scene: SceneStatistics
    hits: HitStatistics
    up_world: Float64[np.ndarray, "3"]
    picture_srgb: Float32[np.ndarray, "h w 3"]
    photographs: int | None


def inspect_scene(scene: StageScene, up_world: Float64[np.ndarray, "3"] | None) -> SceneInspection:
    """Inspect a scene; ``up_world`` is the up direction that the user states for a file.

    Raises:
        ConfigError: the cameras of the photographs share no centre or no up direction.
    """
    table = scene.turntable(up_world)
    if scene.photographs is None:
        (camera,) = turntable_cameras(table, 1, PICTURE_SIDE_PX, PICTURE_SIDE_PX)
        image = camera.rays()
    else:
        image = photograph_cameras(scene.photographs, np.array([0]), PICTURE_SIDE_PX)[0].rays()
    # one small picture is not worth compiling the packets' kernels
    tracer = make_tracer(scene.settings, threads=scene.threads, is_used_once=True)
    tracer.build(scene.gaussians)
    picture = render_rays(tracer, image, scene.background_srgb)
    return SceneInspection(
        scene_statistics(scene.gaussians, table.up_world),
        hit_statistics(tracer, image),
        table.up_world,
        picture.rgb_srgb,
        None if scene.photographs is None else len(scene.photographs.views),
    )
