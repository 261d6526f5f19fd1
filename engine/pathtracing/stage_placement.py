"""Placement of meshes that rest on what a pixel of a photograph, or a ray, meets."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.pathtracing.compile_meshes import load_mesh_shape, mesh_up_axis
from octasplat.engine.pathtracing.mesh_shapes import transform_points, up_axis_rotation
from octasplat.engine.pathtracing.stage.model import RestingPlace, Stage
from octasplat.engine.trace.protocol import Tracer

Ray = tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, "3"]]
RayOfPixel = Callable[[str, tuple[float, float]], Ray]


def place_resting_meshes(
    stage: Stage,
    tracer: Tracer | None,
    ray_of_pixel: RayOfPixel,
    folder: Path,
    origin_world: Origin = NO_ORIGIN,
) -> Stage:
    """Return the stage with the meshes that rest ``on`` something moved there; all about ``origin_world``.

    Raises:
        ConfigError: the stage has no Gaussians, a ray meets nothing, or a photograph is not known.
    """
    up = np.array(stage.up) / np.linalg.norm(stage.up)
    meshes = list(stage.meshes)
    for number, mesh in enumerate(stage.meshes):
        if mesh.on is None:
            continue
        key = f"meshes[{number}].on"
        if tracer is None:
            raise ConfigError(f"{key}: there are no Gaussians on which it could stand.")
        spot = _resting_point(mesh.on, tracer, ray_of_pixel, key)
        shape = load_mesh_shape(mesh, number, folder, origin_world)
        points = transform_points(
            shape.vertices, mesh, up_axis_rotation(mesh_up_axis(mesh), mesh.turn_degrees, up)
        ) - np.array(mesh.position)
        heights = points @ up
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        foot = middle - (middle @ up - heights.min()) * up  # the lowest point under the middle
        position = spot - foot + np.array(mesh.position)
        meshes[number] = mesh.model_copy(update={"position": tuple(float(x) for x in position), "on": None})
    return stage.model_copy(update={"meshes": tuple(meshes)})


def _resting_point(
    rest: RestingPlace, tracer: Tracer, ray_of_pixel: RayOfPixel, key: str
) -> Float64[np.ndarray, "3"]:
    """Return the point of the Gaussians on which a mesh rests."""
    if rest.view is not None and rest.pixel is not None:
        try:
            origin, direction = ray_of_pixel(rest.view, rest.pixel)
        except ConfigError as error:
            raise ConfigError(f"{key}: {error}") from None
        what = f"pixel {rest.pixel[0]:g}, {rest.pixel[1]:g} of {rest.view}"
    else:
        origin, direction = np.array(rest.origin), np.array(rest.direction)
        what = "the ray"
    direction = direction / np.linalg.norm(direction)
    traced = tracer.trace(RayBatch(origin[None], direction[None].astype(np.float32)))
    if not traced.depth_median[0] > 0:
        raise ConfigError(f"{key}: {what} meets nothing solid; choose another.")
    return np.asarray(origin + float(traced.depth_median[0]) * direction)
