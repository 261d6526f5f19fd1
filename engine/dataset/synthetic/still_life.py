"""The still life: placement and material of its objects, and all of it as one mesh.

The world is in metres with z up; the table top is the plane z = 0 around the origin, the floor lies at
``FLOOR_Z``, and eight walls surround both. The roof is open to a sky and to one lamp.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from octasplat.engine.dataset.synthetic import albedo
from octasplat.engine.dataset.synthetic.object_scene import (
    Lamp,
    ObjectScene,
    SceneObject,
    join_objects,
    rotation_z,
)
from octasplat.engine.dataset.synthetic.shapes import (
    TexturedMesh,
    boulder_mesh,
    box_mesh,
    catmull_rom_profile,
    flat_patch,
    join_meshes,
    place_mesh,
    superquadric_mesh,
    surface_of_revolution,
    torus_knot_mesh,
    twisted_tower_mesh,
)

FLOOR_Z = -0.75
TABLE_RADIUS = 1.0
ROOM_INRADIUS = 3.6
WALL_HEIGHT = 4.2


_LAMP = Lamp(np.array([1.9, -1.5, 4.2]), 0.4, np.array([1.0, 0.9, 0.76]) * 42.0)
_SKY_DISTANCE = 20.0


def _rotation_x(degrees: float) -> Float[np.ndarray, "3 3"]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _table_top() -> TexturedMesh:
    under = np.linspace(0, 0.96, 12)
    over = np.linspace(0.985, 0, 130)
    edge = catmull_rom_profile(np.array([[0.985, -0.06], [1.0, -0.045], [1.0, -0.015], [0.985, 0.0]]), 4)
    flat_under = np.stack([under, np.full_like(under, -0.06)], axis=1)
    flat_over = np.stack([over, np.zeros_like(over)], axis=1)[1:]
    return surface_of_revolution(
        np.concatenate([flat_under, edge, flat_over]) * [TABLE_RADIUS, 1], columns=260
    )


def _pedestal_mesh() -> TexturedMesh:
    knots = np.array(
        [
            [0.42, 0.0],
            [0.42, 0.03],
            [0.2, 0.08],
            [0.09, 0.16],
            [0.13, 0.25],
            [0.16, 0.33],
            [0.08, 0.42],
            [0.07, 0.52],
            [0.12, 0.6],
            [0.3, 0.69],
        ]
    )
    return surface_of_revolution(catmull_rom_profile(knots, 8), columns=72)


def _wall_meshes() -> TexturedMesh:
    half = ROOM_INRADIUS * np.tan(np.pi / 8)
    sides = []
    for k in range(8):
        turn = rotation_z(45.0 * k)
        corner = turn @ [ROOM_INRADIUS, half, FLOOR_Z]
        side = flat_patch(corner, turn @ [0.0, -2 * half, 0.0], [0.0, 0.0, WALL_HEIGHT], columns=36, rows=50)
        # u is centred on the side and ten metres apart between sides, so that the material can tell them.
        side.uv[:, 0] += 10 * k - half
        sides.append(side)
    return join_meshes(sides)


def vase_mesh() -> TexturedMesh:
    """Return a vase of 0.51 m, open above."""
    outside = np.array(
        [
            [0.0, 0.0],
            [0.085, 0.0],
            [0.1, 0.02],
            [0.15, 0.11],
            [0.18, 0.2],
            [0.165, 0.29],
            [0.1, 0.375],
            [0.068, 0.43],
            [0.075, 0.48],
            [0.11, 0.51],
        ]
    )
    inside = np.array([[0.1, 0.512], [0.064, 0.475], [0.056, 0.43], [0.09, 0.37], [0.15, 0.28], [0.0, 0.05]])
    return surface_of_revolution(
        np.concatenate([catmull_rom_profile(outside, 10), catmull_rom_profile(inside, 6)]), columns=128
    )


def _scene_objects() -> tuple[SceneObject, ...]:
    stand = np.eye(3)
    floor = flat_patch([-3.95, -3.95, FLOOR_Z], [7.9, 0.0, 0.0], [0.0, 7.9, 0.0], columns=180, rows=180)
    return (
        SceneObject("floor", floor, albedo.floor_tiles, is_foreground=False),
        SceneObject("walls", _wall_meshes(), albedo.room_walls, is_foreground=False),
        SceneObject("table", _table_top(), albedo.table_wood),
        SceneObject("pedestal", place_mesh(_pedestal_mesh(), stand, 0.0, 0.0, FLOOR_Z), albedo.pedestal_wood),
        SceneObject(
            "vase",
            place_mesh(vase_mesh(), rotation_z(20.0), -0.48, 0.36, 0.0),
            albedo.vase_glaze,
            specular=0.12,
        ),
        SceneObject(
            "knot",
            place_mesh(
                torus_knot_mesh(0.078, 0.052, 420, 40), rotation_z(35.0) @ _rotation_x(78.0), 0.42, 0.36, 0.0
            ),
            albedo.knot_glaze,
            specular=0.3,
        ),
        SceneObject(
            "tower",
            place_mesh(
                twisted_tower_mesh(0.125, 0.66, np.radians(70), 0.62, 24), rotation_z(10.0), 0.02, -0.06, 0.0
            ),
            albedo.tower_bricks,
        ),
        SceneObject(
            "boulder",
            place_mesh(boulder_mesh(0.21, 0.28, 160, 110), rotation_z(0.0), 0.5, -0.36, 0.0),
            albedo.boulder_stone,
        ),
        SceneObject(
            "cube",
            place_mesh(superquadric_mesh(0.15, 7.0, 128, 96), rotation_z(28.0), -0.34, -0.46, 0.0),
            albedo.cube_paint,
        ),
        SceneObject(
            "book",
            place_mesh(box_mesh((0.32, 0.44, 0.07), 16), rotation_z(-62.0), -0.02, 0.62, 0.0),
            albedo.book_cloth,
        ),
    )


@lru_cache(maxsize=1)
def build_still_life() -> ObjectScene:
    """Build the still life; it has no parameters and is always the same."""
    return join_objects(_scene_objects(), _LAMP, _SKY_DISTANCE)
