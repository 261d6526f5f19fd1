"""How well Gaussians come back from an edited mesh: least squares over eight corners against three points.

Usage: python benchmarks/edit_recovery.py SCENE.ply [TWISTED_BY_BLENDER.ply]

Exact maps move the vertices of the exported mesh; covariances and centres are compared with those under the
map's derivative at each centre. Covariance errors are relative (Frobenius norm), centre errors in standard
deviations along the longer axis. Vertices are rounded to float32, as a file would.
"""

import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from octasplat.engine.edit.edit_options import MeshToGaussiansOptions
from octasplat.engine.edit.mesh_to_gaussians import recover_gaussians
from octasplat.engine.files import ImportedMesh, export_scene, read_mesh, read_scene
from octasplat.engine.gaussians.legs import legs_world
from octasplat.engine.gaussians.model import FlatGaussians

Map = Callable[[np.ndarray], np.ndarray]
STEP = 1e-5


def twist(rate: float) -> Map:
    def move(p: np.ndarray) -> np.ndarray:
        a = rate * p[..., 2]
        return np.stack(
            [
                np.cos(a) * p[..., 0] - np.sin(a) * p[..., 1],
                np.sin(a) * p[..., 0] + np.cos(a) * p[..., 1],
                p[..., 2],
            ],
            axis=-1,
        )

    return move


def bend(curvature: float) -> Map:
    def move(p: np.ndarray) -> np.ndarray:
        a, r = curvature * p[..., 0], 1 / curvature - p[..., 2]
        return np.stack([r * np.sin(a), p[..., 1], 1 / curvature - r * np.cos(a)], axis=-1)

    return move


def shear(p: np.ndarray) -> np.ndarray:
    return p + 0.5 * p[..., 2:] * [1.0, 0, 0]


def covariances(legs: np.ndarray) -> np.ndarray:
    return legs @ legs.transpose(0, 2, 1)


def derivatives(move: Map, points: np.ndarray) -> np.ndarray:
    columns = [(move(points + STEP * e) - move(points - STEP * e)) / (2 * STEP) for e in np.eye(3)]
    return np.stack(columns, axis=-1)


def fitted_twist(before: ImportedMesh, after: ImportedMesh) -> Map:
    """The exact twist that Blender's SimpleDeform made, from the vertices."""
    a, b = before.vertices, after.vertices
    angles = np.angle((b[:, 0] + 1j * b[:, 1]) / (a[:, 0] + 1j * a[:, 1]))
    rate, phase = np.polyfit(
        a[:, 2], np.unwrap(angles[np.argsort(a[:, 2])])[np.argsort(np.argsort(a[:, 2]))], 1
    )
    turn = np.array([[np.cos(phase), -np.sin(phase), 0], [np.sin(phase), np.cos(phase), 0], [0, 0, 1]])
    move = twist(float(rate))
    assert np.abs(move(a) @ turn.T - b).max() < 1e-4, "this mesh is not a twist about z of the scene's"
    return lambda p: move(p) @ turn.T


def row(name: str, gaussians: FlatGaussians, mesh: ImportedMesh, move: Map) -> None:
    means = gaussians.means_world.astype(np.float64)
    legs = derivatives(move, means) @ legs_world(gaussians)
    for method in ("least-squares", "three-point"):
        options = MeshToGaussiansOptions.model_validate({"method": method, "axes": "x0"})
        result, report = recover_gaussians(gaussians, mesh, Path("mesh.ply"), options)
        expected = covariances(legs)
        error = np.linalg.norm(covariances(legs_world(result)) - expected, axis=(1, 2))
        error /= np.linalg.norm(expected, axis=(1, 2))
        centre = np.linalg.norm(result.means_world - move(means), axis=1) / gaussians.scales.max(axis=1)
        quantiles = np.quantile(error, [0.5, 0.95, 1.0])
        print(
            f"| {name} | {method} | {quantiles[0]:.2%} | {quantiles[1]:.2%} | {quantiles[2]:.1%} "
            f"| {np.median(centre):.1e} | {centre.max():.2f} | {report.residual_median:.1e} "
            f"| {report.residual_max:.2f} |"
        )


def main() -> None:
    gaussians, _ = read_scene(Path(sys.argv[1]))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        export_scene(gaussians, path)
        mesh = read_mesh(path)
    print(f"{len(gaussians):,} Gaussians")
    print(
        "| edit | method | covariance: median | 95 % | max | centre: median | max | residual: median | max |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name, move in (
        ("none", lambda p: p),
        ("shear by 1/2", shear),
        ("twist, 1 rad a unit", twist(1.0)),
        ("bend, radius 1", bend(1.0)),
    ):
        moved = move(mesh.vertices).astype(np.float32).astype(np.float64)
        row(name, gaussians, replace(mesh, vertices=moved), move)
    if len(sys.argv) > 2:
        after = read_mesh(Path(sys.argv[2]))
        row("Blender's SimpleDeform twist, 1 rad", gaussians, after, fitted_twist(mesh, after))


if __name__ == "__main__":
    main()
