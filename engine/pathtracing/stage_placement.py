"""Placement of meshes that rest on what a pixel of a photograph, or a ray, meets."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.pathtracing.compile_meshes import load_mesh_shape, mesh_up_axis
from octasplat.engine.pathtracing.mesh_shapes import rotation_matrix, transform_points, up_axis_rotation
from octasplat.engine.pathtracing.stage.model import RestingPlace, Stage, StageMesh
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
        vertices = load_mesh_shape(mesh, number, folder, origin_world).vertices
        heights = _turned(vertices, mesh, mesh.turn_degrees, up) @ up
        middle = _middle(vertices, mesh, up)
        foot = middle - (middle @ up - heights.min()) * up  # the lowest point under the middle
        position = spot - foot + np.array(mesh.position)
        meshes[number] = mesh.model_copy(update={"position": tuple(float(x) for x in position), "on": None})
    return stage.model_copy(update={"meshes": tuple(meshes)})


def _turned(
    vertices: Float64[np.ndarray, "v 3"], mesh: StageMesh, degrees: float, up: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "v 3"]:
    """Return the vertices of a mesh about its position, where it is turned by some degrees."""
    turn = up_axis_rotation(mesh_up_axis(mesh), degrees, up)
    return transform_points(vertices, mesh, turn) - np.array(mesh.position)


def _middle(
    vertices: Float64[np.ndarray, "v 3"], mesh: StageMesh, up: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    """Return what is the middle of a mesh before its turn, about its position.

    The turn takes it along: boxes around what turns have other middles all the time, and it would sway.
    """
    points = _turned(vertices, mesh, 0.0, up)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    if mesh.turn_degrees != 0.0:
        tilt = rotation_matrix(mesh.rotation_degrees)
        middle = tilt @ up_axis_rotation("world", mesh.turn_degrees, up) @ tilt.T @ middle
    return np.asarray(middle)


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
