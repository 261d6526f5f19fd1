"""The still life: which things stand where, in what material, and all of it as one mesh.

The world is in metres with z up; the table top is the plane z = 0 around the origin, the floor lies at
``FLOOR_Z``, and eight walls surround both. The roof is open to a sky and to one lamp.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from octasplat.engine.scene.generated import materials
from octasplat.engine.scene.generated.meshes import (
    Mesh,
    boulder,
    box,
    joined,
    patch,
    placed,
    revolved,
    rounded_cube,
    smooth_profile,
    torus_knot,
    twisted_tower,
)

FLOOR_Z = -0.75
TABLE_RADIUS = 1.0
ROOM_APOTHEM = 3.6
WALL_HEIGHT = 4.2


@dataclass(frozen=True)
class Thing:
    """One part of the still life; ``is_object`` tells the table and what is on it from the room."""

    name: str
    mesh: Mesh
    material: Callable[[np.ndarray, np.ndarray], np.ndarray]
    is_object: bool = True
    gloss: float = 0.0


@dataclass(frozen=True)
class StillLife:
    """All things as one mesh: its ``faces`` index ``vertices``, ``face_thing`` indexes ``things``."""

    things: tuple[Thing, ...]
    vertices: Float32[np.ndarray, "n 3"]
    faces: Int32[np.ndarray, "m 3"]
    vertex_normals: Float32[np.ndarray, "n 3"]
    uv: Float32[np.ndarray, "n 2"]
    texture_xyz: Float32[np.ndarray, "n 3"]
    face_thing: Int32[np.ndarray, " m"]
    face_is_object: Bool[np.ndarray, " m"]
    face_normals: Float32[np.ndarray, "m 3"]


def _turn_z(degrees: float) -> Float[np.ndarray, "3 3"]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _turn_x(degrees: float) -> Float[np.ndarray, "3 3"]:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _table_top() -> Mesh:
    under = np.linspace(0, 0.96, 12)
    over = np.linspace(0.985, 0, 130)
    edge = smooth_profile(np.array([[0.985, -0.06], [1.0, -0.045], [1.0, -0.015], [0.985, 0.0]]), 4)
    flat_under = np.stack([under, np.full_like(under, -0.06)], axis=1)
    flat_over = np.stack([over, np.zeros_like(over)], axis=1)[1:]
    return revolved(np.concatenate([flat_under, edge, flat_over]) * [TABLE_RADIUS, 1], columns=260)


def _pedestal() -> Mesh:
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
    return revolved(smooth_profile(knots, 8), columns=72)


def _walls() -> Mesh:
    half = ROOM_APOTHEM * np.tan(np.pi / 8)
    sides = []
    for k in range(8):
        turn = _turn_z(45.0 * k)
        corner = turn @ [ROOM_APOTHEM, half, FLOOR_Z]
        side = patch(corner, turn @ [0.0, -2 * half, 0.0], [0.0, 0.0, WALL_HEIGHT], columns=36, rows=50)
        # u is centred on the side and ten metres apart between sides, so that the material can tell them.
        side.uv[:, 0] += 10 * k - half
        sides.append(side)
    return joined(sides)


def _vase() -> Mesh:
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
    return revolved(np.concatenate([smooth_profile(outside, 10), smooth_profile(inside, 6)]), columns=128)


def _things() -> tuple[Thing, ...]:
    stand = np.eye(3)
    floor = patch([-3.95, -3.95, FLOOR_Z], [7.9, 0.0, 0.0], [0.0, 7.9, 0.0], columns=180, rows=180)
    return (
        Thing("floor", floor, materials.floor_tiles, is_object=False),
        Thing("walls", _walls(), materials.room_walls, is_object=False),
        Thing("table", _table_top(), materials.table_wood),
        Thing("pedestal", placed(_pedestal(), stand, 0.0, 0.0, FLOOR_Z), materials.pedestal_wood),
        Thing("vase", placed(_vase(), _turn_z(20.0), -0.48, 0.36, 0.0), materials.vase_glaze, gloss=0.12),
        Thing(
            "knot",
            placed(torus_knot(0.078, 0.052, 420, 40), _turn_z(35.0) @ _turn_x(78.0), 0.42, 0.36, 0.0),
            materials.knot_glaze,
            gloss=0.3,
        ),
        Thing(
            "tower",
            placed(twisted_tower(0.125, 0.66, np.radians(70), 0.62, 24), _turn_z(10.0), 0.02, -0.06, 0.0),
            materials.tower_bricks,
        ),
        Thing(
            "boulder",
            placed(boulder(0.21, 0.28, 160, 110), _turn_z(0.0), 0.5, -0.36, 0.0),
            materials.boulder_stone,
        ),
        Thing(
            "cube",
            placed(rounded_cube(0.15, 7.0, 128, 96), _turn_z(28.0), -0.34, -0.46, 0.0),
            materials.cube_paint,
        ),
        Thing(
            "book",
            placed(box((0.32, 0.44, 0.07), 16), _turn_z(-62.0), -0.02, 0.62, 0.0),
            materials.book_cloth,
        ),
    )


@lru_cache(maxsize=1)
def still_life() -> StillLife:
    """The scene that is photographed; always the same."""
    things = _things()
    whole = joined([thing.mesh for thing in things])
    counts = [len(thing.mesh.faces) for thing in things]
    corners = whole.vertices.astype(np.float64)[whole.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face_thing = np.repeat(np.arange(len(things), dtype=np.int32), counts)
    return StillLife(
        things,
        whole.vertices,
        whole.faces,
        whole.normals,
        whole.uv,
        whole.texture_xyz,
        face_thing,
        np.array([thing.is_object for thing in things])[face_thing],
        (across / np.linalg.norm(across, axis=1, keepdims=True)).astype(np.float32),
    )
