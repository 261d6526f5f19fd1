"""Normals that are handed on: noise on a sphere goes away, edges stay, metals lead."""

import numpy as np

from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.normal_propagation import propagate_normals
from octasplat.engine.train.initialization.initial_gaussians import add_initial_materials


def scene(points: np.ndarray, normals: np.ndarray) -> FlatGaussians:
    count = len(points)
    gaussians = FlatGaussians(
        points.astype(np.float32),
        quaternions_from_matrices(frames_from_normals(normals)).astype(np.float32),
        np.full((count, 2), -3.0, np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    return add_initial_materials(gaussians, MaterialSettings())


def angles(gaussians: FlatGaussians, normals: np.ndarray) -> np.ndarray:
    cosine = np.abs((gaussians.rotations[:, :, 0] * normals).sum(axis=1))
    return np.degrees(np.arccos(np.clip(cosine, 0, 1)))


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_propagate_normals_smooths_sphere_independent_of_sign() -> None:
    rng = np.random.default_rng(0)
    truth = unit(rng.normal(size=(3000, 3)))
    noisy = unit(truth + rng.normal(0, 0.08, truth.shape)) * rng.choice([-1.0, 1.0], (3000, 1))
    gaussians = scene(truth, noisy)
    before = angles(gaussians, truth).mean()
    propagate_normals(gaussians)
    assert angles(gaussians, truth).mean() < before / 2


def test_propagate_normals_keeps_edges_and_follows_metals() -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 30)))
    points = np.concatenate([np.stack([x, y, 0 * x], 1), np.stack([0 * x, y, x + 0.03], 1)])
    normals = np.repeat([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], 900, axis=0)
    gaussians = scene(points, normals)
    propagate_normals(gaussians)
    assert angles(gaussians, normals).max() < 1e-2
    # Every other one is wrong by ten degrees and rough, the others are mirrors.
    wrong = np.arange(1800) % 2 == 1
    tilted = np.where(wrong[:, None], unit(normals + np.array([0.0, 0.176, 0.0])), normals)
    gaussians = scene(points, tilted)
    gaussians.channels["metallic"][:] = 1.0
    gaussians.channels["roughness"][:] = np.where(wrong, 1.0, 0.0)[:, None]
    propagate_normals(gaussians)
    assert angles(gaussians, normals).mean() < 1.5  # five, if all counted the same


def test_propagate_normals_keeps_normals_across_materials() -> None:
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(0, 1, (2000, 2)), np.zeros((2000, 1))], axis=1)
    metal = points[:, 0] < 0.5
    normals = np.where(metal[:, None], [[0.0, 0.0, 1.0]], unit(np.array([[0.2, 0.0, 1.0]])))
    gaussians = scene(points, normals)
    gaussians.channels["metallic"][:] = metal[:, None]
    propagate_normals(gaussians)
    assert angles(gaussians, normals).max() < 0.1
