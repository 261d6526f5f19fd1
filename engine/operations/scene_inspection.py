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
        up_world: the direction that points up; known of a run, a guess of a file.
        photographs: how many; None of a file.
    """

    scene: SceneStatistics
    up_world: Float64[np.ndarray, "3"]
    photographs: int | None


@dataclass(frozen=True)
class TracedPicture:
    """A small picture of a scene.

    Attributes:
        rgb_srgb: display values, from the first photograph's place of a run.
        hits: of its rays.
    """

    rgb_srgb: Float32[np.ndarray, "h w 3"]
    hits: HitStatistics


def inspect_scene(scene: StageScene, up_world: Float64[np.ndarray, "3"] | None) -> SceneInspection:
    """Inspect a scene; ``up_world`` is the up direction that the user states for a file.

    Raises:
        ConfigError: the cameras of the photographs share no up direction.
    """
    up = scene.turntable(up_world).up_world
    photographs = None if scene.photographs is None else len(scene.photographs.views)
    return SceneInspection(scene_statistics(scene.gaussians, up), up, photographs)


def trace_picture(scene: StageScene, up_world: Float64[np.ndarray, "3"] | None) -> TracedPicture:
    """Trace a small picture of a scene, as :func:`inspect_scene` does of its facts.

    Raises:
        ConfigError: the cameras of the photographs share no up direction.
    """
    if scene.photographs is None:
        (camera,) = turntable_cameras(scene.turntable(up_world), 1, PICTURE_SIDE_PX, PICTURE_SIDE_PX)
        image = camera.rays()
    else:
        image = photograph_cameras(scene.photographs, np.array([0]), PICTURE_SIDE_PX)[0].rays()
    # one small picture is not worth compiling the packets' kernels
    tracer = make_tracer(scene.settings, threads=scene.threads, is_used_once=True)
    tracer.build(scene.gaussians)
    picture = render_rays(tracer, image, scene.background_srgb)
    return TracedPicture(picture.rgb_srgb, hit_statistics(tracer, image))
