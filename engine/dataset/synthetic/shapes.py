"""Triangle meshes of simple shapes, each made of grids with smooth normals inside and sharp edges between.

All shapes are in their own frame, z up, in metres; faces wind anticlockwise as seen from outside.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int32

from octasplat.engine.dataset.synthetic.patterns import gradient_noise

Vector = Sequence[float] | Float[np.ndarray, "3"]


@dataclass(frozen=True)
class TexturedMesh:
    """A triangle mesh with what its texture needs.

    Attributes:
        vertices: Positions in metres.
        faces: Vertex indices, anticlockwise as seen from outside.
        normals: Unit normals of the vertices, outwards.
        uv: Surface coordinates; their unit is the shape's own.
        texture_xyz: Positions before placement, so that a solid texture moves with its object.
    """

    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    normals: Float32[np.ndarray, "n 3"]
    uv: Float32[np.ndarray, "n 2"]
    texture_xyz: Float32[np.ndarray, "n 3"]


def _vertex_normals(
    vertices: Float[np.ndarray, "n 3"], faces: Int32[np.ndarray, "m 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Return area-weighted normals; vertices at the same place share one, so that seams are invisible."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    _, place = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    place = place.reshape(-1)  # NumPy 2.0 gives the inverse a second axis
    sums = np.zeros((place.max() + 1, 3))
    for k in range(3):
        np.add.at(sums, place[faces[:, k]], across)
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)
    return sums[place].astype(np.float32)


def grid_surface(
    points: Float[np.ndarray, "rows columns 3"], uv: Float[np.ndarray, "rows columns 2"]
) -> TexturedMesh:
    """Return the surface through a grid of points; seen from outside, columns run right where rows run up.

    Triangles of no area (at poles) are left out.
    """
    rows, columns = points.shape[:2]
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    right, up = corner + 1, corner + columns
    faces = np.concatenate([np.stack([corner, right, up + 1], 1), np.stack([corner, up + 1, up], 1)])
    vertices = points.reshape(-1, 3)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-12].astype(np.int32)
    as_float32 = vertices.astype(np.float32)
    return TexturedMesh(
        as_float32,
        faces,
        _vertex_normals(vertices, faces),
        uv.reshape(-1, 2).astype(np.float32),
        as_float32,
    )


def join_meshes(meshes: Sequence[TexturedMesh]) -> TexturedMesh:
    """Join ``meshes`` to one without merging vertices."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return TexturedMesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.texture_xyz for mesh in meshes]),
    )


def place_mesh(
    mesh: TexturedMesh, rotation: Float[np.ndarray, "3 3"], x: float, y: float, bottom: float
) -> TexturedMesh:
    """Return ``mesh`` rotated by ``rotation``, its origin over (x, y) and its lowest point at ``bottom``."""
    turned = mesh.vertices.astype(np.float64) @ rotation.T
    turned += [x, y, bottom - turned[:, 2].min()]
    normals = mesh.normals.astype(np.float64) @ rotation.T
    return replace(mesh, vertices=turned.astype(np.float32), normals=normals.astype(np.float32))


def flat_patch(corner: Vector, along: Vector, up: Vector, columns: int, rows: int) -> TexturedMesh:
    """Return a parallelogram that faces ``along`` x ``up``; uv are metres from ``corner``."""
    s, t = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    points = (
        np.asarray(corner, float)
        + s[..., None] * np.asarray(along, float)
        + t[..., None] * np.asarray(up, float)
    )
    uv = np.stack([s * np.linalg.norm(along), t * np.linalg.norm(up)], axis=-1)
    return grid_surface(points, uv)


def box_mesh(size: Sequence[float], cells: int) -> TexturedMesh:
    """Return a box that stands on z = 0 around the z axis; each side has ``cells`` rows and columns."""
    x, y, z = (0.5 * size[0], 0.5 * size[1], float(size[2]))
    return join_meshes(
        [
            flat_patch([-x, -y, 0.0], [2 * x, 0.0, 0.0], [0.0, 0.0, z], cells, cells),
            flat_patch([x, -y, 0.0], [0.0, 2 * y, 0.0], [0.0, 0.0, z], cells, cells),
            flat_patch([x, y, 0.0], [-2 * x, 0.0, 0.0], [0.0, 0.0, z], cells, cells),
            flat_patch([-x, y, 0.0], [0.0, -2 * y, 0.0], [0.0, 0.0, z], cells, cells),
            flat_patch([-x, -y, z], [2 * x, 0.0, 0.0], [0.0, 2 * y, 0.0], cells, cells),
            flat_patch([-x, y, 0.0], [2 * x, 0.0, 0.0], [0.0, -2 * y, 0.0], cells, cells),
        ]
    )


def surface_of_revolution(profile: Float[np.ndarray, "k 2"], columns: int) -> TexturedMesh:
    """Return a surface of revolution about z from (radius, height) pairs that ascend along its outside.

    uv: turns about the axis, and metres along the profile.
    """
    angle = np.linspace(0, 2 * np.pi, columns + 1)
    radius, height = profile[:, :1], profile[:, 1:]
    points = np.stack(np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), height), axis=-1)
    # Exactly the first column: the rounded sine of a full turn would open the seam.
    points[:, -1] = points[:, 0]
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(angle / (2 * np.pi), way[:, None]), axis=-1)
    return grid_surface(points, uv)


def catmull_rom_curve(knots: Float[np.ndarray, "k d"], steps: int) -> Float[np.ndarray, "q d"]:
    """Return a Catmull-Rom curve through ``knots`` with ``steps`` points for each segment."""
    padded = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    pieces = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(padded, padded[1:], padded[2:], padded[3:], strict=False)
    ]
    return np.concatenate([*pieces, knots[-1:]])


def catmull_rom_profile(knots: Float[np.ndarray, "k 2"], steps: int) -> Float[np.ndarray, "q 2"]:
    """Return the curve of :func:`catmull_rom_curve` as a profile of a surface of revolution."""
    curve = catmull_rom_curve(knots, steps)
    # The spline may swing past the axis.
    curve[:, 0] = np.maximum(curve[:, 0], 0)
    return curve


def torus_knot_mesh(size: float, tube: float, columns: int, rows: int) -> TexturedMesh:
    """Return a tube of radius ``tube`` along the (2, 3) torus knot of outer radius 3 ``size``.

    uv: turns along the knot and around the tube.
    """
    t = np.linspace(0, 2 * np.pi, columns + 1)
    ring = 2 + np.cos(3 * t)
    centre = size * np.stack([ring * np.cos(2 * t), ring * np.sin(2 * t), 1.3 * np.sin(3 * t)], axis=-1)
    spoke = np.stack([np.cos(2 * t), np.sin(2 * t), np.zeros_like(t)], axis=-1)
    # The knot is closed: neighbors across its end are the last but one and the second point.
    ahead = np.gradient(np.concatenate([centre[-2:-1], centre, centre[1:2]]), axis=0)[1:-1]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, spoke)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    out = np.cross(side, ahead)
    around = np.linspace(0, 2 * np.pi, rows + 1)[:, None, None]
    points = centre + tube * (np.cos(around) * out - np.sin(around) * side)
    points[:, -1] = points[:, 0]
    points[-1] = points[0]
    u, v = np.meshgrid(t / (2 * np.pi), around.reshape(-1) / (2 * np.pi))
    return grid_surface(points, np.stack([u, v], axis=-1))


def _sphere_grid(columns: int, rows: int) -> tuple[Float[np.ndarray, "r c 3"], Float[np.ndarray, "r c 2"]]:
    """Return unit vectors on a longitude-latitude grid; uv: turns, and half turns from the bottom."""
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    across = np.sin(np.pi * v)
    # The rounded sine of pi is above 0, and would give the triangles at a pole an area.
    across[[0, -1]] = 0
    directions = np.stack(
        [across * np.cos(2 * np.pi * u), across * np.sin(2 * np.pi * u), -np.cos(np.pi * v)], axis=-1
    )
    directions[:, -1] = directions[:, 0]
    return directions, np.stack([u, v], axis=-1)


def superquadric_mesh(radius: float, exponent: float, columns: int, rows: int) -> TexturedMesh:
    """Return the superquadric |x|^p + |y|^p + |z|^p = radius^p with p = ``exponent``."""
    directions, uv = _sphere_grid(columns, rows)
    reach = np.sum(np.abs(directions) ** exponent, axis=-1, keepdims=True) ** (-1 / exponent)
    return grid_surface(radius * reach * directions, uv)


def boulder_mesh(radius: float, roughness: float, columns: int, rows: int) -> TexturedMesh:
    """Return a slightly flattened sphere, displaced along its radius by noise."""
    directions, uv = _sphere_grid(columns, rows)
    flat = directions.reshape(-1, 3).astype(np.float32)
    coarse = gradient_noise(flat * 1.7, octaves=2, seed=11)
    # Folding the noise at zero carves creases, as on weathered stone.
    height = 0.9 * coarse - 0.55 * np.abs(gradient_noise(flat * 3.1, octaves=3, seed=12))
    reach = radius * (1 + roughness * height.astype(np.float64)).reshape(*directions.shape[:2], 1)
    return grid_surface(reach * directions * [1.0, 1.0, 0.8], uv)


def twisted_tower_mesh(
    half_width: float, height: float, twist: float, taper: float, cells: int
) -> TexturedMesh:
    """Return a square tower that twists by ``twist`` radians and narrows to ``taper`` of its width.

    uv: metres from the middle of a side (before narrowing) plus 10 for each further side, and metres up.
    """
    s, t = np.meshgrid(np.linspace(-1, 1, cells + 1), np.linspace(0, 1, 3 * cells + 1))

    def turned(x: np.ndarray, y: np.ndarray, level: np.ndarray) -> np.ndarray:
        angle, scale = twist * level, half_width * (1 - (1 - taper) * level)
        return np.stack(
            [
                scale * (x * np.cos(angle) - y * np.sin(angle)),
                scale * (x * np.sin(angle) + y * np.cos(angle)),
                height * level,
            ],
            axis=-1,
        )

    sides = []
    for k, (x, y) in enumerate(
        [(s, -np.ones_like(s)), (np.ones_like(s), s), (-s, np.ones_like(s)), (-np.ones_like(s), -s)]
    ):
        uv = np.stack([half_width * s + 10 * k, height * t], axis=-1)
        sides.append(grid_surface(turned(x, y, t), uv))
    x, y = np.meshgrid(np.linspace(-1, 1, cells + 1), np.linspace(-1, 1, cells + 1))
    uv = np.stack([half_width * x + 40, half_width * y], axis=-1)
    return join_meshes([*sides, grid_surface(turned(x, y, np.ones_like(x)), uv)])
