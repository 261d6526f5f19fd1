"""What ``octasplat surface`` does once its options are understood."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
from jaxtyping import UInt8
from pydantic import ValidationError

from octasplat.engine.colour import to_bytes
from octasplat.engine.config import read_config
from octasplat.engine.errors import ConfigError, DatasetError, OutputError
from octasplat.engine.events import Listener
from octasplat.engine.files import check_surface_path, read_facts, write_surface
from octasplat.engine.gaussians.materials import require_materials
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.operations.axes import light_up
from octasplat.engine.rays import ImageRays
from octasplat.engine.render.cameras import RenderCamera
from octasplat.engine.run_folder import (
    CONFIG,
    ENVIRONMENT,
    SCENE,
    found_model,
    is_run,
    open_photographs,
    photographs_folder,
    run_exposures,
    run_viewpoints,
)
from octasplat.engine.scene import Dataset, load_scene
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.shading.exposure import Exposures
from octasplat.engine.surface.cameras import cameras_around, photograph_cameras
from octasplat.engine.surface.extract import ExtractedSurface, extract_levels
from octasplat.engine.surface.fitting import Picture
from octasplat.engine.surface.materials import material_features
from octasplat.engine.surface.options import SurfaceOptions
from octasplat.engine.trace.make import make_tracer
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.engine.writing import replacing
from octasplat.workers.cli.progress import show_progress
from octasplat.workers.cli.scene_files import open_scene

MATERIAL_DEFAULTS = {"texture_side": 1024, "max_triangles": 60_000}
"""With materials, where nothing else is said."""

ROOM: Mapping[str, object] = {
    "unbounded": True,
    "unseen": "solid",
    "backdrop": True,
    "resolution": 720,
    "truncation": 3.0,
    "min_weight": 0.3,
    "depth_side": 320,
    "settle": True,
}
"""What suits pictures of a room, measured on one; see docs/surface.md."""


@dataclass(frozen=True)
class Asked:
    """What a surface is wanted of, and where.

    Attributes:
        source: folder of a run, or a file of Gaussians.
        output: the mesh's file.
        scene: folder of photographs, see the command.
        materials: whether it is to be lit.
        up: the axis that then points up; None for that of the run.
        levels: for several levels of detail in place of one, what each adds to the file's name and its number
            of triangles.
    """

    source: Path
    output: Path
    scene: Path | None
    materials: bool = False
    up: str | None = None
    levels: Mapping[str, int] = field(default_factory=dict)

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The file of each level."""
        if not self.levels:
            return (self.output,)
        return tuple(
            self.output.with_name(f"{self.output.stem}_{name}{self.output.suffix}") for name in self.levels
        )


def run_surface(
    asked: Asked, given: dict[str, Any], *, threads: int, quiet: bool, should_stop: Callable[[], bool]
) -> None:
    """Extract a surface and write it.

    Args:
        asked: of what, and where.
        given: fields of :class:`SurfaceOptions`.
        threads: for everything; 0 means all cores.
        quiet: show warnings only.
        should_stop: asked now and then.

    Raises:
        OctasplatError: something cannot be read, found or written.
        Cancelled: stopped as asked.
    """
    source, output = asked.source, asked.output
    try:
        options = SurfaceOptions.model_validate(MATERIAL_DEFAULTS | given if asked.materials else given)
    except ValidationError as error:
        raise ConfigError(f"{error.errors()[0]['msg'].removeprefix('Value error, ')}.") from None
    check_surface_path(output, textured=options.texture_side is not None, lit=asked.materials)
    gaussians = _read_gaussians(source, quiet)
    features, frame, light = None, None, None
    if asked.materials:
        require_materials(gaussians, source / SCENE if is_run(source) else source)
        features, frame = material_features(gaussians), environment_frame(light_up(source, asked.up))
        light = _light_to_copy(source, output)
    cameras, settings = _cameras(source, asked.scene, gaussians, options)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output.parent} cannot be made ({error.strerror or error}).") from None
    tracer = make_tracer(settings, threads=threads, build_quality=2)
    tracer.build(gaussians, features)
    with show_progress(quiet=quiet, should_stop=should_stop) as listener:
        photographs = _photographs(source, asked.scene, threads, listener) if options.fit else ()
        surfaces = extract_levels(
            tracer, cameras, options, tuple(asked.levels.values()) or (options.max_triangles,),
            scratch=output.parent, light_frame=frame, photographs=photographs,
            listener=listener, should_stop=should_stop,
        )  # fmt: skip
    for surface, place in zip(surfaces, asked.outputs, strict=True):
        files = write_surface(surface.mesh, place)
        if not quiet:
            click.echo(_summary(surface))
            _tell_written(files)
    if light is not None:
        copied = _copied(light, output.with_name(ENVIRONMENT))
        if not quiet:
            _tell_written((copied,))


def _tell_written(files: tuple[Path, ...]) -> None:
    for path in files:
        click.echo(f"Wrote {path} ({path.stat().st_size / 1e6:.1f} MB).")


def _light_to_copy(source: Path, output: Path) -> Path | None:
    """The run's environment, if it has one that is not beside the output already.

    Raises:
        OutputError: there is another one.
    """
    light, place = source / ENVIRONMENT, output.with_name(ENVIRONMENT)
    if not (is_run(source) and light.exists()):
        return None
    if not place.exists():
        return light
    if place.samefile(light) or place.read_bytes() == light.read_bytes():
        return None
    raise OutputError(
        f"{place} is another environment than that of {source}; remove it, or name a file elsewhere."
    )


def _copied(light: Path, place: Path) -> Path:
    try:
        with replacing(place) as temporary:
            shutil.copyfile(light, temporary)
    except OSError as error:
        raise OutputError(f"{place} cannot be written ({error.strerror or error}).") from None
    return place


def _read_gaussians(source: Path, quiet: bool) -> FlatGaussians:
    if is_run(source) and not (source / SCENE).exists():
        raise OutputError(
            f"{source} holds no {SCENE} yet; finish the run with octasplat reconstruct --resume."
        )
    return open_scene(source, quiet=quiet)


def _cameras(
    source: Path, scene: Path | None, gaussians: FlatGaussians, options: SurfaceOptions
) -> tuple[tuple[RenderCamera, ...], TraceSettings]:
    """Where to render depth from, and with which settings of the tracer."""
    if is_run(source) and (source / CONFIG).exists():
        seen = run_viewpoints(source, scene=scene)
        train = read_config(source / CONFIG).train
        near_world = train.near * seen.extent
        return photograph_cameras(seen, seen.train_indices, options.depth_side, near_world), train.trace
    facts = read_facts(source)
    settings = TraceSettings(turned_beyond=facts.turned_beyond)
    if scene is not None:
        photographs = load_scene(scene)
        every = np.arange(len(photographs.views))
        return photograph_cameras(photographs, every, options.depth_side, facts.near_world), settings
    return cameras_around(gaussians, options.depth_side), settings


def _photographs(source: Path, scene: Path | None, threads: int, listener: Listener) -> tuple[Picture, ...]:
    """The training photographs of a run, all as exposed as the scene, if they are on this machine."""
    if not (is_run(source) and (source / CONFIG).exists()):
        return ()
    config = read_config(source / CONFIG)
    if config.train.materials.learn:
        return ()
    try:
        folder, model = photographs_folder(source, scene), found_model(source)
        dataset = open_photographs(folder, source, config, threads, listener, model_folder=model)
    except (DatasetError, OutputError):
        return ()
    exposures = None
    if (known := run_exposures(source)) is not None:
        exposures = Exposures.known([view.name for view in dataset.views], known)
    return tuple(partial(_photograph, dataset, exposures, index) for index in dataset.train_indices.tolist())


def _photograph(
    dataset: Dataset, exposures: Exposures | None, index: int
) -> tuple[ImageRays, UInt8[np.ndarray, "h w 4"]]:
    rgb, alpha, weight = dataset.view_image(index)
    if exposures is not None:
        rgb = exposures.undone(rgb, index)
    solid = (alpha * weight)[..., None]
    return dataset.view_rays(index), to_bytes(np.concatenate([rgb * solid, solid], axis=2))


def _summary(extracted: ExtractedSurface) -> str:
    mesh, region, edges = extracted.mesh, extracted.region, extracted.edges
    closed = "watertight" if edges.watertight else f"{edges.open_edges:,} open edges"
    voxel = f"{region.voxel_world:.3g}{' at the centre' if region.contracted else ''}"
    return (
        f"{len(mesh.faces):,} triangles, {closed}; voxels of {voxel}, "
        f"{extracted.volume_bytes / 1e6:,.0f} MB of volume"
        + (f", {extracted.holes_closed:,} holes closed" if extracted.holes_closed else "")
        + "."
    )
