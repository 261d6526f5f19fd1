"""The physics example: Gaussians ride in a lattice, and what comes out can be filmed."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.pose_paths import look_at
from octasplat.engine.trace.cpu.tracer import CpuTracer

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "physics"


@pytest.fixture(scope="module", autouse=True)
def example_path():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        yield


def load(name: str) -> ModuleType:
    return importlib.import_module(name)


@pytest.fixture(scope="module")
def box() -> TriangleMesh:
    """A closed box of 2 x 1 x 1 with its least corner at (-1, -0.5, 0)."""
    corners = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)])
    vertices = (corners * [2, 1, 1] + [-1, -0.5, 0]).astype(np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return TriangleMesh(vertices, np.array(faces, np.int32))


@pytest.fixture(scope="module")
def skin(box) -> FlatGaussians:
    """Opaque Gaussians all over the box."""
    rng = np.random.default_rng(3)
    share = rng.uniform(0, 1, (1500, 3))
    axis, side = rng.integers(0, 3, 1500), rng.integers(0, 2, 1500)
    share[np.arange(1500), axis] = side
    normals = np.eye(3)[axis] * np.where(side, 1.0, -1.0)[:, None]
    return FlatGaussians(
        (share * [2, 1, 1] + [-1, -0.5, 0]).astype(np.float32),
        quaternions_from_matrices(frames_from_normals(normals)).astype(np.float32),
        np.full((1500, 2), np.log(0.06), np.float32),
        np.full(1500, 5.0, np.float32),
        np.full((1500, 1, 3), 1.0, np.float32),
    )


def test_lattice_holds_the_box(box):
    lattice = load("soft_body").lattice_around(box, 0.26)
    assert lattice.nodes_world.min() < -1
    assert 2.0 <= lattice.volume < 2 * (2 + 0.52) * (1 + 0.52) ** 2
    corners = lattice.nodes_world[lattice.tetrahedra]
    edges = corners[:, 1:] - corners[:, :1]
    volumes = np.linalg.det(edges) / 6
    np.testing.assert_allclose(volumes, 0.26**3 / 6, rtol=1e-6)  # all positive
    # Tetrahedra fit together: every triangle inside has one on each side.
    sides = np.sort(
        lattice.tetrahedra[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3), axis=1
    )
    _, counts = np.unique(sides, axis=0, return_counts=True)
    assert set(counts) == {1, 2}
    outer = (counts == 1).sum()
    cells = np.prod(np.round(np.ptp(lattice.nodes_world, axis=0) / 0.26))
    assert cells == len(lattice.cells)  # a box of cells
    across = np.round(np.ptp(lattice.nodes_world, axis=0) / 0.26)
    assert outer == 4 * (across[0] * across[1] + across[1] * across[2] + across[2] * across[0])


def test_physics_proxy_rest_and_affine_motion_are_exact(box, skin):
    soft_body = load("soft_body")
    lattice = soft_body.lattice_around(box, 0.3)
    rider = soft_body.Rider(skin, lattice)
    np.testing.assert_allclose(rider.at(lattice.nodes_world).means_world, skin.means_world, atol=1e-6)
    matrix = np.array([[1.2, 0.3, 0.0], [0.0, 0.9, 0.1], [0.2, 0.0, 1.1]])
    moved = rider.at(lattice.nodes_world @ matrix.T + [0, 0, 2])
    np.testing.assert_allclose(moved.means_world, skin.means_world @ matrix.T + [0, 0, 2], atol=1e-5)
    for before, after in zip(covariances(skin), covariances(moved), strict=True):
        np.testing.assert_allclose(after, matrix @ before @ matrix.T, atol=2e-6)


def covariances(gaussians: FlatGaussians) -> np.ndarray:
    axes = gaussians.rotations[:, :, 1:] * gaussians.scales[:, None, :]
    return np.einsum("nik,njk->nij", axes, axes).astype(np.float64)


def test_physics_object_takes_nearby_gaussians_only(box, skin):
    far = skin.select(np.arange(10))
    far.means_world[:] += np.float32([0, 0, 3])
    inside = skin.select(np.arange(1))
    inside.means_world[:] = (0.1, 0.1, 0.5)
    every = load("drop").concatenate([skin, far, inside])
    belongs = load("soft_body").belongs_to(every, box, 0.05)
    assert belongs[:1500].all()
    assert not belongs[1500:1510].any()
    assert belongs[1510]


def test_film_of_a_bend_has_no_holes(box, skin):
    """A quarter bend about the y axis: every ray towards the bent box still ends on it."""
    soft_body, drop = load("soft_body"), load("drop")
    lattice = soft_body.lattice_around(box, 0.2)
    rider = soft_body.Rider(skin, lattice)
    frames = np.stack([bent(lattice.nodes_world, angle) for angle in (0.0, 0.4, 0.8)])
    camera = PinholeCamera.from_pose(
        look_at(np.array([0.0, -5.0, 1.5]), np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        48,
        36,
        fy_px=focal_from_fov(35, 36),
    )
    tracer = CpuTracer(threads=1)
    still = skin.select(np.arange(1))
    still.means_world[:] = (0, 50, 0)
    images = list(drop.film(still, rider, frames, camera, tracer))
    assert [image.shape for image in images] == [(36, 48, 3)] * 3
    # Points all over the front of the bent box: the tracer finds it covered there.
    x, z = np.meshgrid(np.linspace(-0.9, 0.9, 30), np.linspace(0.1, 0.9, 15))
    front = np.stack([x.ravel(), np.full(x.size, -0.5), z.ravel()], axis=1)
    for angle, image in zip((0.0, 0.4, 0.8), images, strict=True):
        pixels = camera.project(bent(front, angle)).astype(int)
        shown = image[pixels[:, 1], pixels[:, 0]]
        assert shown.min() > 0.6, angle  # the background is black


def bent(points: np.ndarray, angle: float) -> np.ndarray:
    """Points bent upwards: x becomes an angle of at most ``angle`` at |x| = 1."""
    if angle == 0:
        return points
    turn, reach = points[:, 0] * angle, 1 / angle - points[:, 2]
    return np.stack([reach * np.sin(turn), points[:, 1], 1 / angle - reach * np.cos(turn)], axis=1)


def test_physics_gaussians_follow_cloth(skin):
    drape = load("drape")
    vertices, triangles = drape.round_grid(np.array([0.0, 0.0, -0.01]), 1.3, 20)
    radii = np.linalg.norm(vertices[:, :2], axis=1)
    assert 1.2 < radii.max() <= 1.3 * 1.1 and set(np.unique(triangles)) == set(range(len(vertices)))
    standing = drape.stands_on(skin, np.zeros(3), 0.7, 0.05, 0.5)
    offsets = np.linalg.norm(skin.means_world[:, :2], axis=1)
    np.testing.assert_array_equal(standing, (offsets <= 0.7) & (skin.means_world[:, 2] <= 0.5))
    rider = drape.ClothRider(skin, vertices, triangles)
    turn = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    moved = rider.at(vertices @ turn.T + [0, 0, 2])
    np.testing.assert_allclose(moved.means_world, skin.means_world @ turn.T + [0, 0, 2], atol=1e-5)


def test_mujoco_lets_a_cloth_sag(tmp_path):
    if importlib.util.find_spec("mujoco") is None:
        pytest.skip("mujoco is not installed; pip install -c constraints.txt -e '.[examples]'")
    vertices, triangles = load("drape").round_grid(np.array([0.0, 0.0, 0.6]), 1.0, 12)
    frames = load("mujoco_drop").simulate_cloth(
        vertices, triangles, FOLDER / "pedestal.xml", seconds=1.0, fps=10, young=1e6
    )
    assert frames.shape == (10, len(vertices), 3)
    np.testing.assert_array_equal(frames[0], vertices)
    middle = np.linalg.norm(vertices[:, :2], axis=1) < 0.2
    rim = np.linalg.norm(vertices[:, :2], axis=1) > 0.9
    assert frames[-1, middle, 2].min() > -0.1  # it lies on the ball, whose top is at -0.07
    assert frames[-1, rim, 2].mean() < -0.2
    lengths = [
        np.linalg.norm(f[triangles[:, 0]] - f[triangles[:, 1]], axis=1) for f in (frames[0], frames[-1])
    ]
    assert np.median(lengths[1] / lengths[0]) == pytest.approx(1.0, abs=0.1)  # bent, not stretched


def test_physics_mujoco_object_falls(box, tmp_path):
    if importlib.util.find_spec("mujoco") is None:
        pytest.skip("mujoco is not installed; pip install -c constraints.txt -e '.[examples]'")
    lattice = load("soft_body").lattice_around(box, 0.5)
    world = tmp_path / "world.xml"
    world.write_text(
        '<mujoco><option integrator="discrete" solver="CG"/>'
        '<worldbody><geom type="plane" size="9 9 1"/></worldbody></mujoco>'
    )
    frames = load("mujoco_drop").simulate(
        lattice, world, move=(0.0, 0.0, 1.0), seconds=1.0, fps=10, young=2e5
    )
    assert frames.shape == (10, len(lattice.nodes_world), 3)
    np.testing.assert_allclose(frames[0], lattice.nodes_world + np.array([0, 0, 1]))
    fallen = frames[3, :, 2].mean() - frames[0, :, 2].mean()
    assert fallen == pytest.approx(-0.5 * 9.81 * 0.3**2, rel=0.03)
    lowest = frames[-1, :, 2].min()
    assert -0.1 < lowest < 0.15  # it lies on the ground
    assert (np.ptp(frames[-1], axis=0) > 0.7 * np.ptp(frames[0], axis=0)).all()
