"""The small textured surface that is written beside a scene; the operation ``surface`` makes better ones."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.files import read_metadata
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.runs.surface_inputs import depth_cameras
from octasplat.engine.surface.extract import extract_levels
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.trace.factory import make_tracer

MAX_VIEWS = 36
MAX_TRIANGLES = 16_000
"""Cutting the mesh open for its texture takes most of the time, which grows with the triangles."""
OPTIONS = ExtractionOptions(resolution=192, depth_side=320, texture_size=1024, max_memory_gb=1.0)


def small_surface(
    source: Path,
    gaussians: FlatGaussians,
    *,
    threads: int = 0,
    scratch: Path,
    on_pass: Callable[[], None] = lambda: None,
) -> TriangleMesh:
    """Return a textured mesh of a scene, as the views of its run show it.

    The space is that which the cameras surround; where they surround none, all of it, with ever coarser
    triangles.

    Args:
        source: the folder of a run, or a file of Gaussians, which is looked at from all around.
        gaussians: the scene.
        threads: to use; 0 takes all.
        scratch: folder for a temporary file of the depth maps.
        on_pass: called now and then; it may raise to stop.

    Raises:
        ConfigError: no surface is found.
    """
    gaussians = replace(gaussians, channels=Channels())  # nothing but colors is baked
    cameras, settings = depth_cameras(source, None, gaussians, OPTIONS.depth_side)
    tracer = make_tracer(settings, threads=threads)
    tracer.build(gaussians)

    def extract(options: ExtractionOptions) -> TriangleMesh:
        (found,) = extract_levels(
            tracer,
            _some(cameras),
            options,
            (MAX_TRIANGLES,),
            scratch=scratch,
            photographs=None,
            listener=lambda _event: on_pass(),
        )
        facts = read_metadata(source)
        return replace(found.mesh, origin_world=facts.origin_world, georeference=facts.georeference)

    try:
        return extract(OPTIONS)
    except ConfigError:
        return extract(OPTIONS.model_copy(update={"unbounded": True}))


def _some(cameras: Sequence[PinholeCamera]) -> tuple[PinholeCamera, ...]:
    """Return not more than ``MAX_VIEWS`` of them, spread evenly."""
    count = min(len(cameras), MAX_VIEWS)
    return tuple(cameras[k] for k in np.linspace(0, len(cameras) - 1, count).round().astype(int).tolist())
