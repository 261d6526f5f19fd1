"""What ``octasplat surface`` does once its options are understood."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
from pydantic import ValidationError

from engine.config import read_config
from engine.errors import ConfigError, DatasetError, OutputError
from engine.gaussians.model import FlatGaussians
from engine.gaussians.ply import read_near_world
from engine.pipeline import CONFIG, SCENE, run_scene
from engine.render.cameras import RenderCamera
from engine.scene import load_scene, scene_extent, split_views
from engine.surface.cameras import cameras_around, photograph_cameras
from engine.surface.extract import ExtractedSurface, extract_surface
from engine.surface.files import check_surface_path, write_surface
from engine.surface.options import SurfaceOptions
from engine.trace.make import make_tracer
from engine.trace.protocol import TraceSettings
from workers.options import is_run
from workers.progress import show_progress
from workers.scene_files import open_scene


def run_surface(
    source: Path,
    output: Path,
    given: dict[str, Any],
    scene: Path | None,
    *,
    threads: int,
    quiet: bool,
    should_stop: Callable[[], bool],
) -> None:
    """Extract a surface and write it.

    Args:
        source: folder of a run, or a file of Gaussians.
        output: the mesh's file.
        given: fields of :class:`SurfaceOptions`.
        scene: folder of photographs, see the command.
        threads: for everything; 0 means all cores.
        quiet: show warnings only.
        should_stop: asked now and then.

    Raises:
        OctasplatError: something cannot be read, found or written.
        Cancelled: stopped as asked.
    """
    try:
        options = SurfaceOptions.model_validate(given)
    except ValidationError as error:
        raise ConfigError(f"{error.errors()[0]['msg'].removeprefix('Value error, ')}.") from None
    check_surface_path(output, textured=options.texture_side is not None)
    gaussians = _read_gaussians(source, quiet)
    cameras, settings = _cameras(source, scene, gaussians, options)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output.parent} cannot be made ({error.strerror or error}).") from None
    tracer = make_tracer(settings, threads=threads, build_quality=2)
    tracer.build(gaussians)
    with show_progress(quiet=quiet, should_stop=should_stop) as listener:
        extracted = extract_surface(
            tracer, cameras, options, scratch=output.parent, listener=listener, should_stop=should_stop
        )
    files = write_surface(extracted.mesh, output)
    if not quiet:
        click.echo(_summary(extracted))
        for path in files:
            click.echo(f"Wrote {path} ({path.stat().st_size / 1e6:.1f} MB).")


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
        config = read_config(source / CONFIG)
        photographs = load_scene(scene or run_scene(source), max_side=config.max_side)
        names = [view.name for view in photographs.views]
        indices, _ = split_views(names, config.test_every, config.held_out)
        origins = np.stack([photographs.views[index].origin_world for index in indices])
        near_world = config.train.near * scene_extent(origins, photographs.points)
        settings = config.train.trace
    elif scene is not None:
        photographs = load_scene(scene)
        indices, settings = np.arange(len(photographs.views)), TraceSettings()
        near_world = read_near_world(source)
    else:
        return cameras_around(gaussians, options.depth_side), TraceSettings()
    if len(indices) == 0:
        raise DatasetError(f"{photographs.root} has no photographs to look from.")
    return photograph_cameras(photographs, indices, options.depth_side, near_world), settings


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
