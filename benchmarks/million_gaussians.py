"""A scene of a million Gaussians to time pictures of: a wavy ground of 40 x 40 and 60 balls on it.

python -m benchmarks.million_gaussians million.ply
"""

import argparse
from pathlib import Path

import numpy as np

from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians

COUNT, SIDE, BALLS = 1_000_000, 40.0, 60


def million_gaussians() -> FlatGaussians:
    """Return Gaussians on surfaces, half of them on the ground, with harmonics of degree 3."""
    rng = np.random.default_rng(0)
    half = COUNT // 2
    x, z = rng.uniform(-SIDE / 2, SIDE / 2, (half, 2)).T
    ground = np.stack([x, -0.3 * np.sin(x) * np.cos(z), z], axis=1)
    upwards = np.stack([0.3 * np.cos(x) * np.cos(z), np.ones(half), -0.3 * np.sin(x) * np.sin(z)], axis=1)
    outwards = rng.normal(size=(COUNT - half, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    middles = np.stack(
        [rng.uniform(-15, 15, BALLS), np.full(BALLS, -1.0), rng.uniform(-15, 15, BALLS)], axis=1
    )
    balls = middles[rng.integers(0, BALLS, COUNT - half)] + outwards
    positions, normals = np.concatenate([ground, balls]), np.concatenate([upwards, outwards])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = np.cross(normals, rng.normal(size=normals.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    frames = np.stack([normals, across, np.cross(normals, across)], axis=2)
    area = np.where(np.arange(COUNT) < half, SIDE**2 / half, BALLS * 4 * np.pi / (COUNT - half))
    sh = np.concatenate(
        [0.4 / SH_C0 * np.sin(1.7 * positions)[:, None], rng.normal(0, 0.02, (COUNT, 15, 3))], axis=1
    )
    return FlatGaussians(
        positions.astype(np.float32),
        quaternions_from_matrices(frames).astype(np.float32),
        np.log(np.sqrt(area)[:, None] * rng.uniform(0.5, 1.5, (COUNT, 2))).astype(np.float32),
        rng.uniform(0, 4, COUNT).astype(np.float32),
        sh.astype(np.float32),
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", type=Path)
    write_gaussian_ply(million_gaussians(), parser.parse_args().output)
