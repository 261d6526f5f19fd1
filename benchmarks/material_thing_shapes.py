"""The things of ``benchmarks.material_things``: parts of meshes with known materials at each vertex.

All are made here, by formulas; z is up. Materials vary from vertex to vertex and are linear between: base
color (linear), roughness (perceptual) and metallic as in glTF 2.0.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int32

from octasplat.engine.dataset.synthetic.patterns import (
    cell_noise,
    checkerboard,
    gradient_noise,
    linear_from_hex,
    smoothstep,
)
from octasplat.engine.dataset.synthetic.shapes import (
    TexturedMesh,
    box_mesh,
    catmull_rom_curve,
    catmull_rom_profile,
    grid_surface,
    join_meshes,
    superquadric_mesh,
    surface_of_revolution,
    twisted_tower_mesh,
)

RADIUS = 1.2
"""Of the sphere around the origin that a finished thing fits into, world units."""
Materials = tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]
Paint = Callable[[TexturedMesh], Materials]


@dataclass(frozen=True)
class Thing:
    """A mesh with what is true of its surface.

    Attributes:
        vertices: world units; the thing lies within ``RADIUS`` of the origin.
        faces: rows of vertices, anticlockwise as seen from outside.
        normals: unit normals of the vertices, outwards.
        albedo_linear: base color; of metals what they reflect.
        roughness: perceptual.
        metallic: share of the metal.
    """

    vertices: Float32[np.ndarray, "v 3"]
    faces: Int32[np.ndarray, "f 3"]
    normals: Float32[np.ndarray, "v 3"]
    albedo_linear: Float32[np.ndarray, "v 3"]
    roughness: Float32[np.ndarray, " v"]
    metallic: Float32[np.ndarray, " v"]


# --- materials ---


def even(color: str, roughness: float, metallic: float) -> Paint:
    """Return one material everywhere, its color as ``rrggbb`` (display values)."""
    rgb = linear_from_hex(color)

    def paint(mesh: TexturedMesh) -> Materials:
        count = len(mesh.vertices)
        return np.tile(rgb, (count, 1)), np.full(count, roughness), np.full(count, metallic)

    return paint


def mixed(below: Paint, above: Paint, share: Callable[[TexturedMesh], Float[np.ndarray, " n"]]) -> Paint:
    """Return ``below`` where ``share`` is 0, ``above`` where it is 1."""

    def paint(mesh: TexturedMesh) -> Materials:
        part = np.asarray(share(mesh), np.float64)
        mean = [
            a + (b - a) * part.reshape(-1, *[1] * (a.ndim - 1))
            for a, b in zip(below(mesh), above(mesh), strict=True)
        ]
        return mean[0], mean[1], mean[2]

    return paint


def blotches(scale: float, threshold: float, seed: int) -> Callable[[TexturedMesh], np.ndarray]:
    """Return the mask of irregular spots with sharp borders."""

    def mask(mesh: TexturedMesh) -> np.ndarray:
        noise = gradient_noise(mesh.texture_xyz * np.float32(scale), octaves=4, seed=seed)
        return smoothstep(threshold - 0.03, threshold + 0.03, noise)

    return mask


def bands(axis: int, *ranges: tuple[float, float]) -> Callable[[TexturedMesh], np.ndarray]:
    """Return the mask of ranges along an axis of the part's own frame."""

    def mask(mesh: TexturedMesh) -> np.ndarray:
        along = mesh.texture_xyz[:, axis]
        return np.any([(along > low) & (along < high) for low, high in ranges], axis=0).astype(np.float64)

    return mask


def checks(columns: float, rows: float) -> Callable[[TexturedMesh], np.ndarray]:
    """Return a chequered mask of so many squares for each unit of u and v."""
    return lambda mesh: checkerboard(mesh.uv[:, 0] * np.float32(columns), mesh.uv[:, 1] * np.float32(rows))


def flakes(columns: float, rows: float, seed: int) -> Callable[[TexturedMesh], np.ndarray]:
    """Return a random grey for each cell of u and v."""
    return lambda mesh: cell_noise(
        mesh.uv[:, 0] * np.float32(columns), mesh.uv[:, 1] * np.float32(rows), seed=seed
    )


def stripes(count: float, width: float) -> Callable[[TexturedMesh], np.ndarray]:
    """Return the mask of stripes along v, so many for each unit of u, of a share of their distance."""
    return lambda mesh: (np.mod(mesh.uv[:, 0] * count, 1.0) < width).astype(np.float64)


# --- shapes ---


def moved(mesh: TexturedMesh, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> TexturedMesh:
    """Return a mesh moved by (x, y, z)."""
    return replace(mesh, vertices=mesh.vertices + np.array([x, y, z], np.float32))


def turned(mesh: TexturedMesh, axis: int, degrees: float) -> TexturedMesh:
    """Return a mesh turned about an axis of the world through the origin."""
    angle = np.radians(degrees)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[[i, i, j, j], [i, j, i, j]] = [np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)]
    vertices, normals = (a.astype(np.float64) @ rotation.T for a in (mesh.vertices, mesh.normals))
    return replace(mesh, vertices=vertices.astype(np.float32), normals=normals.astype(np.float32))


def tube(centres: Float[np.ndarray, "k 3"], radius: float, rows: int = 24) -> TexturedMesh:
    """Return a tube with round ends along a line of points; uv: share of the line, and turns around it."""
    ahead = np.gradient(centres, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead[0], np.eye(3)[np.argmin(np.abs(ahead[0]))])
    sides = []
    for direction in ahead:  # carried on along the line, so that the tube does not twist
        side = side - (side @ direction) * direction
        side = side / np.linalg.norm(side)
        sides.append(side)
    across = np.array(sides)
    out = np.cross(ahead, across)
    cap = np.sin(np.linspace(0, np.pi / 2, 6))[:-1]
    reach = np.concatenate([cap, np.ones(len(centres)), cap[::-1]])
    centre = np.concatenate(
        [
            centres[:1] - radius * np.sqrt(1 - cap[:, None] ** 2) * ahead[:1],
            centres,
            centres[-1:] + radius * np.sqrt(1 - cap[::-1, None] ** 2) * ahead[-1:],
        ]
    )
    pad = ((len(cap), len(cap)), (0, 0))
    out, across = np.pad(out, pad, mode="edge"), np.pad(across, pad, mode="edge")
    angle = np.linspace(0, 2 * np.pi, rows + 1)[:, None, None]
    points = centre + radius * reach[:, None] * (np.cos(angle) * out + np.sin(angle) * across)
    points[-1] = points[0]
    u, v = np.meshgrid(np.linspace(0, 1, len(centre)), np.linspace(0, 1, rows + 1))
    return grid_surface(points, np.stack([u, v], axis=-1))


def curve(*knots: tuple[float, float, float], steps: int = 24) -> Float[np.ndarray, "k 3"]:
    """Return a smooth line through points."""
    return catmull_rom_curve(np.array(knots), steps)


def ring(radius: float, tube_radius: float, columns: int = 160, rows: int = 32) -> TexturedMesh:
    """Return a torus about the z axis."""
    angle = np.linspace(-np.pi, np.pi, rows + 1)
    profile = np.stack([radius + tube_radius * np.cos(angle), tube_radius * np.sin(angle)], axis=1)
    return surface_of_revolution(profile, columns)


def lathe(*knots: tuple[float, float], columns: int = 320, steps: int = 16) -> TexturedMesh:
    """Return a smooth surface of revolution about z through (radius, height) pairs along its outside."""
    return surface_of_revolution(catmull_rom_profile(np.array(knots), steps), columns)


def pipe(*knots: tuple[float, float], columns: int = 240) -> TexturedMesh:
    """Return a surface of revolution with sharp edges between straight pieces of its outside."""
    pieces = []
    for (r0, z0), (r1, z1) in itertools.pairwise(knots):
        count = max(2, int(np.hypot(r1 - r0, z1 - z0) / 0.012))
        pieces.append(surface_of_revolution(np.linspace((r0, z0), (r1, z1), count + 1), columns))
    return join_meshes(pieces)


def ball(radius: float, exponent: float = 2.0) -> TexturedMesh:
    """Return a sphere, or a rounder or squarer superquadric."""
    return superquadric_mesh(radius, exponent, 200, 120)


def thing_of(parts: list[tuple[TexturedMesh, Paint]]) -> Thing:
    """Join parts, and lay and scale them into the sphere of ``RADIUS`` around the origin."""
    found = [(mesh, paint(mesh)) for mesh, paint in parts]
    whole = join_meshes([mesh for mesh, _ in found])
    low, high = whole.vertices.min(axis=0), whole.vertices.max(axis=0)
    vertices = whole.vertices - (low + high) / 2
    vertices *= RADIUS / np.linalg.norm(vertices, axis=1).max()
    albedo, roughness, metallic = (
        np.concatenate([materials[k] for _, materials in found]).astype(np.float32) for k in range(3)
    )
    return Thing(vertices, whole.faces, whole.normals, albedo, roughness, metallic)


# --- the things ---

STEEL, CHROME = even("d8d8dc", 0.28, 1.0), even("eeeef0", 0.08, 1.0)
GOLD, COPPER = even("ffd98a", 0.14, 1.0), even("f0b08c", 0.2, 1.0)
RUBBER, BLACK = even("26262a", 0.85, 0.0), even("101014", 0.12, 0.0)


def kettle() -> Thing:
    """Return a kettle: steel body with a painted belt, copper spout, wooden handle on thin wires, a lid."""
    paint = mixed(even("1d6f78", 0.22, 0.0), even("e8e0c8", 0.22, 0.0), checks(24, 9))
    body = mixed(mixed(CHROME, STEEL, bands(2, (0.62, 2.0))), paint, bands(2, (0.2, 0.42)))
    profile = [(0.0, 0.0), (0.72, 0.0), (0.86, 0.08), (0.9, 0.3), (0.78, 0.62), (0.5, 0.86), (0.34, 0.92)]
    wood = mixed(even("8a4f24", 0.45, 0.0), even("4a2610", 0.6, 0.0), blotches(9.0, 0.05, 3))
    bow = [(-0.62, 0.0, 1.18), (-0.36, 0.0, 1.5), (0.0, 0.0, 1.6), (0.36, 0.0, 1.5), (0.62, 0.0, 1.18)]
    wires = [
        curve((s * 0.62, 0.0, 1.18), (s * 0.72, y, 0.95), (s * 0.7, y * 1.5, 0.72), steps=12)
        for s in (-1, 1) for y in (-0.06, 0.06)
    ]  # fmt: skip
    spout = curve((0.7, 0.0, 0.3), (1.05, 0.0, 0.45), (1.15, 0.0, 0.75), (1.38, 0.0, 0.95))
    parts = [
        (lathe(*profile), body),
        (pipe((0.36, 0.9), (0.38, 0.94), (0.34, 0.97), (0.0, 1.02)), STEEL),
        (moved(ball(0.11, 3.0), z=1.12), even("a01818", 0.1, 0.0)),
        (tube(curve(*bow), 0.065, 40), wood),
        (tube(spout, 0.1, 48), COPPER),
        (moved(ring(0.885, 0.022, 240), z=0.44), GOLD),
        (moved(ring(0.9, 0.022, 240), z=0.17), GOLD),
        *((tube(wire, 0.02, 16), CHROME) for wire in wires),
    ]
    return thing_of(parts)


def bowl() -> Thing:
    """Return a deep golden bowl, hollow and mirroring itself, with balls in it, on a chequered foot."""
    outside = [(0.2, 0.3), (0.6, 0.42), (0.92, 0.7), (1.0, 1.05)]
    inside = [(0.97, 1.06), (0.86, 0.74), (0.55, 0.5), (0.0, 0.42)]
    hammered = mixed(GOLD, even("ffd98a", 0.35, 1.0), flakes(40, 14, 5))
    foot = mixed(even("d8d2c4", 0.5, 0.0), even("3a4a8a", 0.25, 0.0), checks(16, 10))
    speckled = mixed(even("2d7a3a", 0.15, 0.0), even("e6c020", 0.5, 0.0), blotches(7.0, 0.1, 8))
    rib = tube(curve((0.62, 0.0, 0.08), (0.8, 0.0, 0.35), (0.99, 0.0, 0.72), steps=16), 0.018, 12)
    parts = [
        (lathe(*outside), hammered),
        (lathe(*inside), even("ffd98a", 0.1, 1.0)),
        (moved(ring(0.985, 0.035, 280), z=1.055), CHROME),
        (pipe((0.0, 0.0), (0.7, 0.0), (0.66, 0.12), (0.2, 0.2), (0.2, 0.34)), foot),
        (moved(ball(0.26), 0.25, 0.12, 0.75), even("b01c2c", 0.08, 0.0)),
        (moved(ball(0.2), -0.3, 0.2, 0.72), CHROME),
        (moved(ball(0.22), -0.05, -0.34, 0.72), speckled),
        *((turned(rib, 2, 45.0 * k), STEEL) for k in range(8)),
    ]
    return thing_of(parts)


def engine() -> Thing:
    """Return an engine: rusty painted block, thin cooling fins, chrome pipes, bolts and a plastic cap."""
    rust = mixed(even("24507c", 0.3, 0.0), even("7a3c18", 0.8, 0.0), blotches(3.0, 0.12, 2))
    worn = mixed(even("c8ccd0", 0.22, 1.0), even("b8b8b0", 0.55, 1.0), blotches(5.0, 0.0, 6))
    fins = [moved(box_mesh((0.9, 0.9, 0.022), 60), z=0.82 + 0.085 * k) for k in range(6)]
    bolts = [
        moved(pipe((0.0, 0.0), (0.07, 0.0), (0.07, 0.06), (0.0, 0.075), columns=6 * 24), x, y, 0.7)
        for x in (-0.48, 0.48) for y in (-0.33, 0.33)
    ]  # fmt: skip
    pipes = [
        curve(
            (0.55, y, 0.25), (0.95, y, 0.3), (1.1, 0.7 * y, 0.7), (0.95, 0.5 * y, 1.2), (0.62, 0.3 * y, 1.5)
        )
        for y in (-0.3, 0.0, 0.3)
    ]
    cap = pipe((0.18, 1.32), (0.18, 1.42), (0.12, 1.48), (0.0, 1.48))
    disc = pipe((0.0, -0.04), (0.29, -0.04), (0.29, 0.04), (0.0, 0.04))
    parts = [
        (box_mesh((1.2, 0.9, 0.7), 130), rust),
        (moved(pipe((0.3, 0.7), (0.3, 1.32), (0.0, 1.32)), z=0.0), worn),
        *((fin, even("b0b4b8", 0.35, 1.0)) for fin in fins),
        *((bolt, even("ffd98a", 0.25, 1.0)) for bolt in bolts),
        *((tube(line, 0.075, 36), CHROME) for line in pipes),
        (cap, even("d03818", 0.1, 0.0)),
        (moved(turned(ring(0.3, 0.03), 0, 90), -0.2, -0.5, 0.36), RUBBER),
        (moved(turned(disc, 0, 90), -0.2, -0.5, 0.36), worn),
    ]
    return thing_of(parts)


def lamp() -> Thing:
    """Return a lamp: twisted painted foot, thin rod, hollow shade of brass and enamel, a chrome ball."""
    tiles = mixed(even("e4dccc", 0.18, 0.0), even("b0402c", 0.5, 0.0), checks(22, 22))
    enamel = mixed(even("f0ece0", 0.12, 0.0), even("20487a", 0.12, 0.0), stripes(18, 0.4))
    outside = pipe((0.78, 1.3), (0.8, 1.3), (0.34, 1.95), (0.0, 1.97))
    inside = pipe((0.0, 1.93), (0.31, 1.93), (0.77, 1.3))
    link = ring(0.045, 0.012, 40, 12)
    chain = [moved(turned(link, 0, 90.0 * (k % 2)), 0.55, 0.0, 1.3 - 0.075 * k) for k in range(6)]
    parts = [
        (twisted_tower_mesh(0.36, 0.62, np.radians(80), 0.5, 70), tiles),
        (moved(box_mesh((0.95, 0.95, 0.07), 60), z=-0.07), even("3c2a1c", 0.35, 0.0)),
        (tube(np.linspace((0.0, 0.0, 0.6), (0.0, 0.0, 1.9), 40), 0.035), even("e8c878", 0.2, 1.0)),
        (outside, enamel),
        (inside, even("ffd98a", 0.16, 1.0)),
        (moved(ball(0.17), z=1.45), CHROME),
        (moved(ball(0.19), z=0.72), mixed(COPPER, even("3c8a70", 0.7, 0.0), blotches(5.0, 0.08, 4))),
        *((part, even("e8c878", 0.2, 1.0)) for part in chain),
    ]
    return thing_of(parts)


def cart() -> Thing:
    """Return a toy cart: lacquered body, chrome grille and bumpers, rubber tyres, spoked wheels, a driver."""
    lacquer = mixed(even("c01824", 0.1, 0.0), even("f4f0e8", 0.1, 0.0), bands(1, (-0.08, 0.08)))
    scratched = mixed(lacquer, even("909498", 0.4, 1.0), blotches(4.0, 0.3, 9))
    spoke = tube(np.linspace((0, 0, -0.22), (0, 0, 0.22), 12), 0.02, 12)
    wheel = join_meshes(
        [*(turned(spoke, 1, 45.0 * k) for k in range(4)), turned(ring(0.17, 0.02, 100, 16), 0, 90)]
    )
    tyre = turned(ring(0.25, 0.085, 120), 0, 90)
    corners = [(x, y) for x in (-0.62, 0.62) for y in (-0.52, 0.52)]
    grille = [
        tube(np.linspace((0.96, y, 0.34), (0.96, y, 0.62), 12), 0.018, 16) for y in np.linspace(-0.3, 0.3, 9)
    ]
    bar = tube(curve((0.9, -0.5, 0.26), (1.06, -0.25, 0.26), (1.06, 0.25, 0.26), (0.9, 0.5, 0.26)), 0.045, 32)
    hood = ball(0.5, 4.0)
    hood = replace(hood, vertices=hood.vertices * np.array([1.9, 0.84, 0.5], np.float32))
    normals = hood.normals / np.array([1.9, 0.84, 0.5], np.float32)
    hood = replace(hood, normals=normals / np.linalg.norm(normals, axis=1, keepdims=True))
    parts = [
        (moved(hood, z=0.5), scratched),
        (moved(ball(0.2), -0.2, 0.0, 1.1), even("e0a878", 0.5, 0.0)),
        (moved(pipe((0.2, 0.72), (0.13, 1.0), (0.0, 1.0)), -0.2), even("1c3c7c", 0.7, 0.0)),
        (moved(pipe((0.27, 1.14), (0.27, 1.17), (0.19, 1.17), (0.19, 1.3), (0.0, 1.32)), -0.2), BLACK),
        *((moved(tyre, x, y, 0.3), RUBBER) for x, y in corners),
        *((moved(wheel, x, y, 0.3), GOLD) for x, y in corners),
        *((part, CHROME) for part in (*grille, bar, turned(bar, 2, 180.0))),
        (moved(turned(ring(0.16, 0.02, 80, 16), 1, 60), 0.16, 0.0, 0.9), BLACK),
        *((moved(ball(0.1), 0.88, y, 0.62), CHROME) for y in (-0.3, 0.3)),
    ]
    return thing_of(parts)


THINGS: dict[str, Callable[[], Thing]] = {
    "kettle": kettle, "bowl": bowl, "engine": engine, "lamp": lamp, "cart": cart,
}  # fmt: skip
