"""The scene that a render shows, a run's data for it, and the requested cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.errors import ConfigError, OutputError
from octasplat.engine.core.events import EventListener, Noted, Warned
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin, vertices_about
from octasplat.engine.core.relative_paths import normalize_name
from octasplat.engine.dataset.model import Viewpoints
from octasplat.engine.dataset.views_file import SplitViewpoints
from octasplat.engine.files import read_metadata
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.gaussians.materials import has_materials
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.operations.axes import axis_named
from octasplat.engine.operations.render_options import PictureRequest
from octasplat.engine.operations.scene_io import open_scene, open_scene_about
from octasplat.engine.operations.written_files import check_targets
from octasplat.engine.render.orbit import (
    Orbit,
    PinholeLens,
    choose_fov_y_degrees,
    orbit_cameras,
    single_camera,
)
from octasplat.engine.render.output import RenderOutput, ResumeOptions
from octasplat.engine.render.path_file import path_cameras
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import background_color
from octasplat.engine.render.shots import Shot, gaussian_turntable, view_shots
from octasplat.engine.runs.run_folder import (
    CONFIG,
    SCENE,
    is_full_run,
    run_extent,
    run_min_view_distance,
    run_viewpoints,
)
from octasplat.engine.trace.protocol import TraceSettings

if TYPE_CHECKING:
    from octasplat.engine.pathtracing.stage_scene import StageScene
    from octasplat.engine.shading.background import LearnedBackground
    from octasplat.engine.shading.deferred import DeferredShading
    from octasplat.engine.shading.residual_colors import ResidualColors

_NO_LIGHT = "a file does not hold the light that its materials were learnt in."
_SOME_WITHOUT = "some of its Gaussians came from a scene without materials, so that harmonics are shown."
ANY_SIDE_PX = 1 << 30
"""A cap that no photograph reaches."""


@dataclass(frozen=True)
class RenderSource:
    """A scene to render; what only a run knows is None, or 0, for a file of Gaussians.

    Attributes:
        gaussians: the scene.
        settings: where rays are cut off.
        near_world: distance of the cameras from which on anything is seen.
        background: display color behind the scene, by name.
        viewpoints: where the photographs were taken from.
        max_side: longer side of the photographs in the training, px.
        trained_rad: angle of a pixel of the training.
        trained_extent: scene extent of the training, world units.
        learnt: background that the run has learnt.
        materials: shading of the run's materials in the light that it has learnt.
        residual: the same with the residual colors that it has learnt.
        photographs: where the photographs were taken from, at their full size, if that was asked for.
        origin_world: where the scene has its origin in the coordinates of its user, see
            :mod:`octasplat.engine.core.local_origin`.
    """

    gaussians: FlatGaussians
    settings: TraceSettings
    near_world: float = 0.0
    background: str = "black"
    viewpoints: SplitViewpoints | None = None
    max_side: int | None = None
    trained_rad: float = 0.0
    trained_extent: float | None = None
    learnt: "LearnedBackground | None" = None
    materials: "DeferredShading | None" = None
    residual: "ResidualColors | None" = None
    photographs: Viewpoints | None = None
    origin_world: Origin = NO_ORIGIN

    @property
    def extent_world(self) -> float:
        """Return the radius of the cameras of the training, or of a turntable that fits."""
        if self.trained_extent is not None:
            return self.trained_extent
        return gaussian_turntable(self.gaussians).radius


def read_render_source(
    source: Path,
    progress: EventListener,
    *,
    dataset: Path | None = None,
    max_side: int | None = None,
    full_size: bool = False,
    shading: Literal["materials", "harmonics"] | None = "harmonics",
) -> RenderSource:
    """Read a scene to render.

    Args:
        source: the folder of a run, or a file.
        progress: receives what reading lost.
        dataset: folder of photographs whose cameras to take, instead of those that the run keeps.
        max_side: cap on the longer side of the views, px; None takes the run's.
        full_size: whether to read the cameras at the full size of the photographs, too, as stages need them.
        shading: whether to read the materials' light; None does where the run has learnt it.

    Raises:
        ConfigError: cameras of photographs, or materials, are asked for, of which a file, or the run, knows
            nothing.
        OctasplatError: it cannot be read.
    """
    if not is_full_run(source):
        if dataset is not None:
            raise ConfigError(
                f"{source}: is no folder of a run, so that {dataset} says nothing about it; leave that "
                "folder out, or name the cameras in another way."
            )
        gaussians, facts = open_scene(source, progress), read_metadata(source)
        if shading == "materials":
            raise ConfigError(f"{source}: {_NO_LIGHT} octasplat relight shows materials in a given light.")
        if shading is None and has_materials(gaussians):
            progress(
                Noted(
                    f"{source}: {_NO_LIGHT} Its harmonics are shown; octasplat relight shows its materials "
                    "in a given light."
                )
            )
        # a file says nothing else of its training
        settings = TraceSettings(flip_normal_cos=facts.turned_beyond)
        return RenderSource(
            gaussians,
            settings,
            facts.near_world,
            trained_rad=facts.pixel_rad,
            origin_world=facts.origin_world,
        )
    return _read_run(source, progress, dataset, max_side, full_size=full_size, shading=shading)


def _read_run(
    source: Path,
    progress: EventListener,
    dataset: Path | None,
    max_side: int | None,
    *,
    full_size: bool,
    shading: Literal["materials", "harmonics"] | None,
) -> RenderSource:
    """Read the folder of a run, see :func:`read_render_source`."""
    # here, as a file has no settings and no shading of its own
    from octasplat.engine.runs.config import read_config
    from octasplat.engine.runs.finished_shading import finished_shading, shown_options
    from octasplat.engine.train.shading_factory import (
        ShadingOptions,
        find_background,
        find_deferred,
        find_residual,
    )

    config = read_config(source / CONFIG)
    if not (source / SCENE).exists():
        raise OutputError(
            f"{source} holds no {SCENE} yet; finish the run with octasplat reconstruct --resume."
        )
    viewpoints = run_viewpoints(source, scene=dataset, max_side=max_side)
    # pixels of stages count at full size
    photographs = run_viewpoints(source, scene=dataset, max_side=ANY_SIDE_PX) if full_size else None
    gaussians = read_gaussian_ply(source / SCENE)[0]
    options = shown_options(config.train, gaussians)
    if shading == "materials":
        options = ShadingOptions.from_config(config.train)
        if options.materials is None or not has_materials(gaussians):
            raise ConfigError(f"{source} has learnt no materials; leave out `shading`.")
    elif shading == "harmonics":
        options = replace(options, materials=None)
    elif options.materials is None and config.train.materials.learn and has_materials(gaussians):
        progress(Noted(f"{source}: {_SOME_WITHOUT}"))
    extent = run_extent(source, viewpoints.extent)
    learnt = finished_shading(source, options, extent, scene=gaussians, trace=config.train.trace)
    facts = read_metadata(source)
    return RenderSource(
        gaussians=gaussians,
        settings=config.train.trace,
        near_world=run_min_view_distance(source, viewpoints),
        background=config.evaluation_background,
        viewpoints=viewpoints,
        max_side=config.max_side,
        trained_rad=facts.pixel_rad,
        trained_extent=extent,
        learnt=find_background(learnt),
        materials=find_deferred(learnt),
        residual=find_residual(learnt),
        photographs=photographs,
        origin_world=facts.origin_world,
    )


def requested_cameras(
    request: PictureRequest, source: RenderSource, up_world: Sequence[float] | None = None
) -> tuple[PinholeCamera, ...] | None:
    """Return the cameras of a turntable, path or single image; None for the photographs' views.

    Args:
        request: what is asked for.
        source: the scene.
        up_world: up around a file where the request does not say it; None takes -y.

    Raises:
        ConfigError: a camera cannot stand or look as asked, or the path cannot be used.
    """
    if request.mode == "views":
        return None
    # path files are in the user's coordinates, or about the local origin already
    if request.camera_path is not None:
        given = path_cameras(request.camera_path, str(request.path_file or "of the options")).cameras
        found = _about_origin(given, source.origin_world)
    else:
        origin = np.array(source.origin_world)
        lens = PinholeLens(
            request.width_px,
            request.height_px,
            choose_fov_y_degrees(request.fov_y_degrees, source.viewpoints),
        )
        orbit = Orbit(
            np.array(up_world, np.float64)
            if request.up is None and up_world is not None
            else axis_named(request.up or "-y"),
            None if request.look_at is None else np.array(request.look_at, dtype=np.float64) - origin,
            request.distance,
            request.elevation_degrees,
        )
        if request.camera is not None:
            position = np.array(request.camera) - origin
            found = (single_camera(source.gaussians, source.viewpoints, lens, orbit, position),)
        else:
            found = orbit_cameras(source.gaussians, source.viewpoints, lens, orbit, request.frame_count)
    return tuple(replace(camera, near_world=source.near_world) for camera in found)


def _about_origin(cameras: tuple[PinholeCamera, ...], origin: Origin) -> tuple[PinholeCamera, ...]:
    """Return cameras of a path about the scene's origin; a path drawn on exported files is so already."""
    centres = np.stack([camera.world_from_cam[:3, 3] for camera in cameras])
    # far from the local origin the file's positions are whole
    shifted = vertices_about(centres, origin) - centres
    if not shifted.any():
        return cameras
    moved = []
    for camera in cameras:
        pose = np.array(camera.world_from_cam)
        pose[:3, 3] -= np.array(origin)
        moved.append(
            PinholeCamera.from_pose(
                pose, camera.width_px, camera.height_px,
                fx_px=camera.fx_px, fy_px=camera.fy_px, cx_px=camera.cx_px, cy_px=camera.cy_px,
            )
        )  # fmt: skip
    return tuple(moved)


def requested_views(request: PictureRequest, source: RenderSource) -> tuple[Shot, ...]:
    """Return the requested views of a run's photographs.

    Raises:
        ConfigError: there is no such photograph, or no run.
        OutputError: there are no such views.
    """
    viewpoints = source.viewpoints
    if viewpoints is None:
        raise ConfigError(f"{request.source}: a file has no photographs; choose a turntable, or cameras.")
    if request.photographs is not None:
        numbers = {normalize_name(view.name): number for number, view in enumerate(viewpoints.views)}
        missing = [name for name in request.photographs if normalize_name(name) not in numbers]
        if missing:
            raise ConfigError(f"{missing[0]}: the run has no photograph of this name.")
        return view_shots(
            viewpoints,
            np.array([numbers[normalize_name(name)] for name in request.photographs]),
            source.near_world,
        )
    indices = {
        "train": viewpoints.train_indices,
        "all": np.arange(len(viewpoints.views)),
        "held-out": viewpoints.test_indices,
    }[request.views]
    if len(indices) == 0:
        raise OutputError("The run held out no views; ask for the views train or all.")
    return view_shots(viewpoints, indices, source.near_world)


def picture_output(
    verb: str, request: PictureRequest, shots: Sequence[Shot], inputs: Sequence[Path | None]
) -> RenderOutput:
    """Return where images are written, after a check that no input or foreign file is replaced.

    Args:
        verb: what makes the pictures.
        request: names the output and what is read for all pictures.
        shots: all pictures.
        inputs: what else is read.

    Raises:
        ConfigError: one image is named for several shots, or a file is read.
        OutputError: a file is there and not by the verb.
    """
    resumption = ResumeOptions(request.resume, request.or_anew or request.overwrite, request.frames_folder)
    output = RenderOutput(request.output, request.frame_rate, request.format == "exr", resumption)
    output.check_count(len(shots))
    reads = [request.source, request.dataset, request.path_file, *inputs]
    overwrite = request.overwrite or output.has_begun  # which a series does only after this check
    check_targets(verb, output.files_of(shots), reads, overwrite=overwrite)
    return output


def stage_scene(
    source: RenderSource,
    folder: Path,
    background_srgb: Float32[np.ndarray, "3"],
    progress: EventListener,
    *,
    threads: int = 0,
) -> "StageScene":
    """Return the scene for a stage.

    Args:
        source: the scene, with the cameras at full size.
        folder: where the names of the stage's files are relative to.
        background_srgb: display color behind everything.
        progress: receives what reading files of the stage loses.
        threads: to use; 0 takes all.
    """
    from octasplat.engine.pathtracing.stage_scene import StageScene  # here, as most renders have no stage

    return StageScene(
        gaussians=source.gaussians,
        settings=source.settings,
        photographs=source.photographs,
        folder=folder,
        read_gaussians=lambda path: open_scene_about(path, source.origin_world, progress),
        background_srgb=background_srgb,
        threads=threads,
        warn=lambda message: progress(Warned(message)),
        note=lambda message: progress(Noted(message)),
        origin_world=source.origin_world,
    )


def open_stage_scene(
    source: Path, progress: EventListener, *, dataset: Path | None = None, threads: int = 0
) -> "StageScene":
    """Read a run or a file as the scene for a stage.

    Args:
        source: the folder of a run, or a file.
        progress: receives what reading lost.
        dataset: folder of the photographs, if the run does not keep their cameras.
        threads: to use; 0 takes all.

    Raises:
        OctasplatError: it cannot be read.
    """
    found = read_render_source(source, progress, dataset=dataset, full_size=True)
    background = background_color(found.background)
    return stage_scene(found, source.parent, background, progress, threads=threads)
