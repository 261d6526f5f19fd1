"""What is photographed: objects with materials, joined to one mesh, and the lamp that lights them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from octasplat.engine.dataset.synthetic.shapes import TexturedMesh, join_meshes


@dataclass(frozen=True)
class SceneObject:
    """One object; ``is_foreground`` separates what is to be reconstructed from what surrounds it."""

    name: str
    mesh: TexturedMesh
    material: Callable[[np.ndarray, np.ndarray], np.ndarray]
    is_foreground: bool = True
    specular: float = 0.0


@dataclass(frozen=True)
class Lamp:
    """A disc that faces the origin of the world.

    Attributes:
        position_world: Its middle, metres.
        radius: Of the disc, metres.
        intensity: Linear light; a surface at distance d that faces it has the irradiance intensity / d^2.
    """

    position_world: Float[np.ndarray, "3"]
    radius: float
    intensity: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class ObjectScene:
    """All objects as one mesh: its ``faces`` index ``vertices``, ``face_object`` indexes ``objects``.

    ``sky_distance`` is the length in metres after which a ray to the sky is free.
    """

    objects: tuple[SceneObject, ...]
    lamp: Lamp
    sky_distance: float
    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    vertex_normals: Float32[np.ndarray, "n 3"]
    uv: Float32[np.ndarray, "n 2"]
    texture_xyz: Float32[np.ndarray, "n 3"]
    face_object: Int32[np.ndarray, " m"]
    face_is_foreground: Bool[np.ndarray, " m"]
    face_normals: Float32[np.ndarray, "m 3"]


def join_objects(objects: Sequence[SceneObject], lamp: Lamp, sky_distance: float) -> ObjectScene:
    """Return the scene of ``objects``."""
    joined = join_meshes([scene_object.mesh for scene_object in objects])
    counts = [len(scene_object.mesh.faces) for scene_object in objects]
    corners = joined.vertices.astype(np.float64)[joined.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face_object = np.repeat(np.arange(len(objects), dtype=np.int32), counts)
    return ObjectScene(
        objects=tuple(objects),
        lamp=lamp,
        sky_distance=sky_distance,
        vertices=joined.vertices,
        faces=joined.faces,
        vertex_normals=joined.normals,
        uv=joined.uv,
        texture_xyz=joined.texture_xyz,
        face_object=face_object,
        face_is_foreground=np.array([scene_object.is_foreground for scene_object in objects])[face_object],
        face_normals=(across / np.linalg.norm(across, axis=1, keepdims=True)).astype(np.float32),
    )


def rotation_z(degrees: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about z, anticlockwise as seen from above."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
