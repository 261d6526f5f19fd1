"""A street between two rows of houses, with trees and large objects on its pavements, in sunshine.

The world is in metres with z up; the street runs along x, its middle is y = 0, the ground the plane z = 0.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

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
    Vector,
    boulder_mesh,
    catmull_rom_profile,
    flat_patch,
    grid_surface,
    join_meshes,
    place_mesh,
    superquadric_mesh,
    surface_of_revolution,
    torus_knot_mesh,
    twisted_tower_mesh,
)
from octasplat.engine.dataset.synthetic.still_life import vase_mesh
from octasplat.engine.dataset.synthetic.street_albedo import (
    DISTINCT_FROM,
    SIDE_STEP,
    STOREY,
    WINDOW_STEP,
    facade,
    leaves,
    painted,
    roof_tiles,
    street_ground,
)

LOT = 14.0
"""What each house takes of the street's length."""
FACADE_Y = 9.0
_WIDTH, _DEPTH = 5 * WINDOW_STEP, 4 * WINDOW_STEP
_CELL = 0.35
_ALIKE_UP_TO = 8
"""Longer streets have houses and monuments that are all different."""
# So far away that its radius is seen as half a degree, twice the sun's, at the height of the afternoon's sun.
_SUN_DISTANCE = 400.0
_SUN_WORLD = _SUN_DISTANCE * np.array([0.42, -0.5, 0.76]) / np.linalg.norm([0.42, -0.5, 0.76])
_SUN = Lamp(
    _SUN_WORLD, _SUN_DISTANCE * np.tan(np.radians(0.5)), np.array([1.0, 0.92, 0.8]) * 1.9 * _SUN_DISTANCE**2
)
_SKY_DISTANCE = 300.0


def _wall(corner: Vector, along: Vector, height: float, side: int, cell: float) -> TexturedMesh:
    length = float(np.linalg.norm(along))
    wall = flat_patch(
        corner, along, (0.0, 0.0, height), max(1, round(length / cell)), max(1, round(height / cell))
    )
    wall.uv[:, 0] += SIDE_STEP * side
    return wall


def _gable(x: float, ahead: float, height: float, rise: float, side: int) -> TexturedMesh:
    """Return the triangle under a roof at ``x``, ``ahead`` being the sign of its normal along x."""
    s, t = np.meshgrid(np.linspace(-1, 1, 25), np.linspace(0, 1, 9))
    y = 0.5 * _DEPTH * s * (1 - t) * ahead
    points = np.stack([np.full_like(y, x), y, height + rise * t], axis=-1)
    uv = np.stack([0.5 * _DEPTH * (1 + s) + SIDE_STEP * side, height + rise * t], axis=-1)
    return grid_surface(points, uv)


def _house_meshes(storeys: int, rise: float) -> tuple[TexturedMesh, TexturedMesh]:
    """Return walls and roof of a house that stands around the z axis, its front towards -y."""
    x, y, height = 0.5 * _WIDTH, 0.5 * _DEPTH, STOREY * storeys
    walls = [
        _wall((-x, -y, 0.0), (2 * x, 0.0, 0.0), height, 0, _CELL),
        _wall((x, -y, 0.0), (0.0, 2 * y, 0.0), height, 1, 2 * _CELL),
        _wall((x, y, 0.0), (-2 * x, 0.0, 0.0), height, 2, 2 * _CELL),
        _wall((-x, y, 0.0), (0.0, -2 * y, 0.0), height, 3, 2 * _CELL),
        _gable(x, 1.0, height, rise, 1),
        _gable(-x, -1.0, height, rise, 3),
    ]
    eaves, over = 0.45, 0.3
    slope = np.array([0.0, y + eaves, rise * (y + eaves) / y])
    low = height - rise * eaves / y
    length = 2 * (x + over)
    roof = [
        flat_patch((-x - over, -y - eaves, low), (length, 0.0, 0.0), slope, 32, 16),
        flat_patch((x + over, y + eaves, low), (-length, 0.0, 0.0), slope * [1, -1, 1], 32, 16),
    ]
    return join_meshes(walls), join_meshes(roof)


def half_length(houses: int) -> float:
    """Return half of the length of a street with so many houses on each side, metres."""
    return 0.5 * houses * LOT


def _houses(side: float, houses: int) -> list[SceneObject]:
    """Return the houses of the side of ``side`` times y.

    In a long street no two are alike, since a search for poses takes houses that are alike for one.
    """
    made = []
    first = (houses if side < 0 else 0) + (DISTINCT_FROM if houses > _ALIKE_UP_TO else 0)
    for k in range(houses):
        number = first + k
        storeys, rise = 2 + (5 * number // 3) % 2, 2.2 + 0.4 * (number % 4)
        walls, roof = _house_meshes(storeys, rise)
        turn = rotation_z(0.0 if side > 0 else 180.0)
        place = (
            -half_length(houses) + LOT * (k + 0.5),
            side * (FACADE_Y + 0.5 * _DEPTH + 0.6 * (number % 3)),
        )
        low = float(roof.vertices[:, 2].min())
        made += [
            SceneObject(f"house {number}", place_mesh(walls, turn, *place, 0.0), facade(number, storeys)),
            SceneObject(f"roof {number}", place_mesh(roof, turn, *place, low), roof_tiles(number)),
        ]
    return made


def _scaled(mesh: TexturedMesh, factor: float) -> TexturedMesh:
    """Return a larger ``mesh`` with the same texture."""
    return replace(mesh, vertices=mesh.vertices * np.float32(factor))


def _trees(side: float, houses: int) -> list[SceneObject]:
    trunk_profile = np.array([[0.26, 0.0], [0.17, 0.5], [0.14, 1.6], [0.12, 2.6], [0.05, 3.2]])
    trunk = surface_of_revolution(catmull_rom_profile(trunk_profile, 4), columns=20)
    crown = boulder_mesh(1.7, 0.55, 96, 64)
    made = []
    for k in range(houses - 1):
        number = 2 * k + (side < 0)
        x, y = -half_length(houses) + LOT * (k + 1), side * 8.2
        placed = place_mesh(trunk, np.eye(3), x, y, 0.0)
        made.append(SceneObject(f"trunk {number}", placed, albedo.pedestal_wood))
        size = 0.85 + 0.1 * (number % 4)
        top = place_mesh(_scaled(crown, size), rotation_z(77.0 * number), x, y, 2.1)
        made.append(SceneObject(f"crown {number}", top, leaves(number)))
    return made


def _monuments(side: float, houses: int) -> list[SceneObject]:
    """Return objects like those of the still life, large, one before each house."""
    tower = twisted_tower_mesh(0.125, 0.66, np.radians(70), 0.62, 24)
    kinds: tuple[tuple[str, TexturedMesh, Callable[[np.ndarray, np.ndarray], np.ndarray], float], ...] = (
        ("vase", _scaled(vase_mesh(), 2.6), albedo.vase_glaze, 0.1),
        ("tower", _scaled(tower, 3.0), albedo.tower_bricks, 0.0),
        ("boulder", _scaled(boulder_mesh(0.21, 0.28, 120, 80), 3.0), albedo.boulder_stone, 0.0),
        ("knot", _scaled(torus_knot_mesh(0.078, 0.052, 320, 32), 2.6), albedo.knot_glaze, 0.2),
        ("cube", _scaled(superquadric_mesh(0.15, 7.0, 96, 72), 3.2), albedo.cube_paint, 0.0),
    )  # fmt: skip
    made = []
    for k in range(houses):
        name, mesh, material, specular = kinds[(k + (2 if side < 0 else 0)) % len(kinds)]
        x, y = -half_length(houses) + LOT * (k + 0.5) + 3.1 * (-1) ** k, side * 6.1
        if houses > _ALIKE_UP_TO:
            number = 2 * k + (side < 0)
            mesh, material = _scaled(mesh, 0.85 + 0.05 * (number % 7)), painted(material, number)
        placed = place_mesh(mesh, rotation_z(40.0 * k + 15.0), x, y, 0.0)
        label = f"{name} {k} {'left' if side > 0 else 'right'}"
        made.append(SceneObject(label, placed, material, specular=specular))
    return made


@lru_cache(maxsize=1)
def build_street(houses: int) -> ObjectScene:
    """Build the street with so many houses on each side; it has no other parameters."""
    reach, across = half_length(houses) + 20.0, 30.0
    near = flat_patch(
        (-reach, -across, 0.0), (2 * reach, 0.0, 0.0), (0.0, 2 * across, 0.0), round(2 * reach / 0.4), 150
    )
    far = flat_patch((-400.0, -400.0, -0.05), (800.0, 0.0, 0.0), (0.0, 800.0, 0.0), 80, 80)
    objects = [SceneObject("ground", near, street_ground), SceneObject("far ground", far, street_ground)]
    for side in (1.0, -1.0):
        objects += [*_houses(side, houses), *_trees(side, houses), *_monuments(side, houses)]
    return join_objects(objects, _SUN, _SKY_DISTANCE)
