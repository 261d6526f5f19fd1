"""Images and films of a scene, as the options of ``octasplat render`` or of a job say."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from octasplat.engine.config import read_config
from octasplat.engine.errors import ConfigError, OutputError
from octasplat.engine.events import Listener
from octasplat.engine.files import read_facts
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.light.companions import companions
from octasplat.engine.light.stage import Stage
from octasplat.engine.light.stage_file import named_files
from octasplat.engine.operations.axes import axis_named
from octasplat.engine.render.identity import identity_of
from octasplat.engine.render.jobs import (
    Paint,
    Shot,
    camera_shots,
    gaussian_turntable,
    scene_paint,
    view_shots,
)
from octasplat.engine.render.kept import RECORD, KeptImages
from octasplat.engine.render.names import names_by_number
from octasplat.engine.render.path_file import read_camera_path
from octasplat.engine.render.renderer import background_colour
from octasplat.engine.render.series import Kept, render_film, render_series
from octasplat.engine.run_folder import CONFIG, SCENE, is_run, run_background, run_viewpoints
from octasplat.engine.scene.model import Viewpoints
from octasplat.engine.scene.views_file import SplitViewpoints
from octasplat.engine.shading.learnt_background import LearntBackground
from octasplat.engine.shading.plain import PLAIN
from octasplat.engine.stages import counted_stage
from octasplat.engine.trace.make import make_tracer
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.workers.rendering.cameras import DEFAULT_FPS, cameras_of_options
from octasplat.workers.rendering.stages import StagePlace, painted_stage, preview_stage
from octasplat.workers.telling.losses import open_scene

ANY_SIDE_PX = 1 << 30
"""A cap that no photograph reaches."""
STAGE_LACKS_BACKGROUND = (
    "The background that was learnt is left out on a stage; to show it, and to be lit by it, name the run's "
    "background.exr as the stage's environment."
)


@dataclass(frozen=True)
class Source:
    """A scene to render; what only a run knows is None, or 0, for a bare file of Gaussians."""

    gaussians: FlatGaussians
    settings: TraceSettings
    near_world: float = 0.0
    background: str = "black"
    viewpoints: SplitViewpoints | None = None
    max_side: int | None = None
    trained_rad: float = 0.0
    learnt: LearntBackground | None = None

    @property
    def extent_world(self) -> float:
        """Radius of the cameras, or of a turntable that fits."""
        if self.viewpoints is not None:
            return self.viewpoints.extent
        return gaussian_turntable(self.gaussians).radius


@dataclass(frozen=True)
class SetStage:
    """A stage, and the folder that the names of its files are relative to."""

    stage: Stage
    folder: Path

    def identity(self) -> tuple[object, ...]:
        """What of it decides how a picture looks: itself and the content of its files."""
        files = [self.folder / name for _, name in named_files(self.stage)]
        return self.stage, files, [path.parent / name for path in files for name in companions(path)]


@dataclass(frozen=True)
class Keeping:
    """Where finished images wait for the others, and whether earlier ones are gone on with.

    Attributes:
        resume: go on with the images of a render that was stopped.
        or_anew: where those are of another render, forget them rather than refuse.
        frames: folder of a film's frames; None puts them beside the film.
        on_kept: told how many images are safe on disk.
    """

    resume: bool = False
    or_anew: bool = False
    frames: Path | None = None
    on_kept: Kept = lambda _count: None


def render_files(
    mode: str,
    options: dict[str, Any],
    listener: Listener,
    say: Callable[[str], None],
    stage: SetStage | None = None,
    keeping: Keeping = Keeping(),
) -> tuple[Path, ...]:
    """Render as the options of the command say.

    Args:
        mode: ``views``, ``turntable``, ``camera_path`` or ``camera``.
        options: the options of the command by parameter name.
        listener: hears the progress.
        say: told in a sentence what reading a scene has lost.
        stage: what the scene is set on.
        keeping: how a render that is stopped goes on.

    Returns:
        The files written.

    Raises:
        OctasplatError: the source cannot be read, or the output not written; or there are images of another
            render where this one is to go on.
    """
    output: Path = options["output"]
    if stage is not None:
        stage = replace(stage, stage=_as_asked(stage.stage, options))
    cameras, fps = None, options["fps"] or DEFAULT_FPS
    if mode == "camera_path":
        path = read_camera_path(options["camera_path"])
        cameras, fps = path.cameras, options["fps"] or path.fps
    source = read_source(options, say)
    if mode in ("turntable", "camera"):
        cameras = cameras_of_options(source.gaussians, source.viewpoints, options, fps)
    if cameras is not None:
        cameras = tuple(replace(camera, near_world=source.near_world) for camera in cameras)
    shots = camera_shots(cameras) if cameras is not None else run_shots(source, options)
    check_one_file(output, 1 if options.get("preview") else len(shots))
    transparent = options["background"] == "transparent"
    background = background_colour("black" if transparent else options["background"] or source.background)
    learnt = None if options["background"] else source.learnt  # another colour was asked for, or alpha
    exr = options["exr"] or (stage is not None and stage.stage.integrator.layers)
    series = Series(output, shots, fps, exr, keeping)
    what = source.gaussians, source.settings, background, transparent, cameras, stage and stage.identity()
    of_views = None if cameras is not None else (source.viewpoints, source.near_world)
    if stage is not None:
        if learnt is not None and stage.stage.environment is None:
            say(STAGE_LACKS_BACKGROUND)
        place = StagePlace(
            source.gaussians, source.settings, _full_size(options), stage.folder,
            lambda path: open_scene(path, say), background, options["threads"], say,
        )  # fmt: skip
        set_up = partial(painted_stage, stage.stage, place, shots)
        if options.get("preview"):
            return preview_stage(set_up(), shots[0], output, listener)
        kept = series.kept(identity_of(*what, of_views, place.photographs))
        return series.render(set_up().paint, kept, listener)
    shown = None if learnt is None else learnt.rgb_srgb
    kept = series.kept(identity_of(*what, of_views, source.trained_rad, shown))
    tracer = make_tracer(source.settings, threads=options["threads"], build_quality=2)
    tracer.build(source.gaussians)
    paint = scene_paint(
        tracer, background, transparent=transparent, trained_rad=source.trained_rad, shading=learnt or PLAIN
    )
    return series.render(paint, kept, listener)


def _as_asked(stage: Stage, options: dict[str, Any]) -> Stage:
    """The stage with what the options say of its integrator.

    Raises:
        ConfigError: it asks for layers in files that have none.
    """
    asked = {key: True for key in ("layers", "denoise") if options.get(key)}
    integrator = stage.integrator.model_copy(update=asked)
    if integrator.layers and options["output"].suffix.lower() in (".png", ".mp4"):
        raise ConfigError(f"{options['output']}: holds no layers; name a folder, or .exr files.")
    return stage.model_copy(update={"integrator": integrator})


@dataclass(frozen=True)
class Series:
    """Images or a film to write."""

    output: Path
    shots: tuple[Shot, ...]
    fps: float
    exr: bool
    keeping: Keeping

    @property
    def is_film(self) -> bool:
        """Whether it is a film."""
        return self.output.suffix.lower() == ".mp4"

    def kept(self, identity: str) -> KeptImages:
        """What there is already of images that look as ``identity`` says."""
        keeping, output = self.keeping, self.output
        folder, record = output, RECORD
        if output.suffix.lower() in (".png", ".exr"):
            folder, record = output.parent, f"{output.name}.{RECORD}"
        if self.is_film:
            folder = keeping.frames or output.with_name(f"{output.name}.frames")
        return KeptImages(folder, identity, resume=keeping.resume, or_anew=keeping.or_anew, record=record)

    def render(self, paint: Paint, kept: KeptImages, listener: Listener) -> tuple[Path, ...]:
        """Do so; returns the files."""
        on_kept = self.keeping.on_kept
        with counted_stage("render", listener) as count:
            if self.is_film:
                render_film(self.shots, self.output, self.fps, paint, kept, count, on_kept)
                return (self.output,)
            names = FileNames(self.output, self.exr)
            return render_series(self.shots, names, paint, kept, count, on_kept)


def check_one_file(output: Path, images: int) -> None:
    """Refuse the name of one image where there are several.

    Raises:
        ConfigError: they would all be one file.
    """
    if images > 1 and output.suffix.lower() in (".png", ".exr") and not names_by_number(output):
        pattern = f"{output.stem}_%04d{output.suffix}"
        raise ConfigError(f"{output} names one image for {images}; write a pattern such as {pattern}.")


@dataclass(frozen=True)
class FileNames:
    """The file of a shot: by number in a pattern, by name in a folder."""

    output: Path
    exr: bool

    def __call__(self, number: int, shot: Shot) -> Path:
        """The file of a shot and its number."""
        if self.output.suffix.lower() in (".png", ".exr"):
            if not names_by_number(self.output):
                return self.output
            return self.output.with_name(self.output.name % number)
        return self.output / f"{shot.name}{'.exr' if self.exr else '.png'}"


def read_source(options: dict[str, Any], say: Callable[[str], None]) -> Source:
    """The scene that the options ``source``, ``scene`` and ``max_side`` name: of a run, or of a file.

    Raises:
        OctasplatError: it cannot be read.
    """
    return _read_run(options) if is_run(options["source"]) else _read_file(options, say)


def _read_run(options: dict[str, Any]) -> Source:
    run: Path = options["source"]
    config = read_config(run / CONFIG)
    if not (run / SCENE).exists():
        raise OutputError(f"{run} holds no {SCENE} yet; finish the run with octasplat reconstruct --resume.")
    viewpoints = run_viewpoints(run, scene=options["scene"], max_side=options["max_side"])
    return Source(
        read_gaussian_ply(run / SCENE)[0],
        config.train.trace,
        config.train.near * viewpoints.extent,
        config.evaluate_background,
        viewpoints,
        config.max_side,
        read_facts(run).pixel_rad,
        run_background(run),
    )


def _read_file(options: dict[str, Any], say: Callable[[str], None]) -> Source:
    path: Path = options["source"]
    gaussians = open_scene(path, say)
    facts = read_facts(path)
    settings = TraceSettings(turned_beyond=facts.turned_beyond)
    return Source(gaussians, settings, facts.near_world, trained_rad=facts.pixel_rad)


def stage_place(
    source: Path, scene: Path | None, up: str | None, say: Callable[[str], None]
) -> tuple[StagePlace, Float64[np.ndarray, "3"] | None]:
    """The scene of a run or file in which a stage is to be set, and the direction that is named as up.

    Args:
        source: folder of a run, or file.
        scene: where the run's photographs are, if their cameras are to be read there.
        up: an axis by name.
        say: told in a sentence what reading a scene has lost.

    Raises:
        OctasplatError: the source cannot be read.
    """
    options = {"source": source, "scene": scene, "max_side": None}
    found = read_source(options, say)
    place = StagePlace(
        found.gaussians, found.settings, _full_size(options), source.parent,
        lambda path: open_scene(path, say), background_colour(found.background), 0,
    )  # fmt: skip
    return place, None if up is None else axis_named(up)


def _full_size(options: dict[str, Any]) -> Viewpoints | None:
    """Where the photographs of a run were taken from, at their full size; None of a file."""
    if not is_run(options["source"]):
        return None
    return run_viewpoints(options["source"], scene=options["scene"], max_side=ANY_SIDE_PX)


def run_shots(source: Source, options: dict[str, Any]) -> tuple[Shot, ...]:
    """The views of a run's photographs: those of the option ``photographs``, or as ``views`` says.

    Raises:
        ConfigError: there is no such photograph.
        OutputError: there are no such views.
    """
    viewpoints = source.viewpoints
    assert viewpoints is not None
    names = {view.name: number for number, view in enumerate(viewpoints.views)}
    if asked := options.get("photographs"):
        missing = [name for name in asked if name not in names]
        if missing:
            raise ConfigError(f"{missing[0]}: the run has no photograph of this name.")
        return view_shots(viewpoints, np.array([names[name] for name in asked]), source.near_world)
    every = np.arange(len(viewpoints.views))
    chosen = {"train": viewpoints.train_indices, "all": every}
    indices = chosen.get(options["views"] or "held-out", viewpoints.test_indices)
    if len(indices) == 0:
        raise OutputError("The run held out no views; ask for --views train or all.")
    return view_shots(viewpoints, indices, source.near_world)
