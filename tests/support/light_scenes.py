"""Stages and cameras for the tests of the path tracer."""

from pathlib import Path

import numpy as np

from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians, concatenate
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.film import Film
from octasplat.engine.pathtracing.path_tracer import PathTracer, PathTracerScene
from octasplat.engine.pathtracing.stage.model import Stage
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov

UP = (0.0, -1.0, 0.0)


def camera(
    eye: tuple[float, ...], target: tuple[float, ...], size: tuple[int, int] = (64, 48), fov: float = 45.0
) -> PinholeCamera:
    """A camera that looks from one point to another, with -y up; the field of view is from top to bottom."""
    forward = np.array(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return PinholeCamera.from_pose(pose, *size, fy_px=focal_from_fov(fov, size[1]))


def film_of(
    stage: Stage,
    view: PinholeCamera,
    folder: Path = Path(),
    *,
    background: float = 0.0,
    threads: int = 2,
) -> Film:
    """Render a stage without Gaussians."""
    scene = PathTracerScene(compile_meshes(stage, folder, threads=threads), None, np.full(3, background))
    return PathTracer(scene, stage.integrator, threads=threads).render(view.rays())


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Decibels between two pictures of values up to 1."""
    error = float(np.mean((a.astype(np.float64) - b) ** 2))
    return float("inf") if error == 0 else -10 * np.log10(error)


def table_with_a_box() -> FlatGaussians:
    """A grey table from -1 to 1 at y = 0 (up is -y) with a red box of side 0.3 in its middle."""
    sheets = [_sheet(np.zeros(3), np.eye(3)[0], np.eye(3)[2], 1.0, 40, (0.5, 0.5, 0.5))]
    for axis in range(3):
        for sign in (-1.0, 1.0):
            n = sign * np.eye(3)[axis]
            centre = np.array([0.0, -0.15, 0.0]) + 0.15 * n
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            sheets.append(_sheet(centre, u, v, 0.15, 10, (0.8, 0.1, 0.1)))
    return concatenate(sheets)


def shiny_ball(
    count: int, radius: float, *, albedo: tuple[float, ...], metallic: float, roughness: float
) -> FlatGaussians:
    """Opaque Gaussians on a sphere, evenly spread (Fibonacci's spiral), of one material."""
    k = np.arange(count) + 0.5
    polar, around = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    n = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=1)
    u = np.cross(n, np.where(np.abs(n[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    scale = radius * np.sqrt(4 * np.pi / count) * 0.6
    scene = FlatGaussians(
        (radius * n).astype(np.float32),
        quaternions_from_matrices(np.stack([n, u, np.cross(n, u)], axis=2)).astype(np.float32),
        np.full((count, 2), np.log(scale), np.float32),
        np.full(count, 6.0, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    return scene.with_channels(
        {
            "albedo": np.tile(np.float32(albedo), (count, 1)),
            "metallic": np.full((count, 1), metallic, np.float32),
            "roughness": np.full((count, 1), roughness, np.float32),
        }
    )


def _sheet(
    centre: np.ndarray, u: np.ndarray, v: np.ndarray, half: float, side: int, rgb: tuple[float, ...]
) -> FlatGaussians:
    """Opaque Gaussians side by side in a square."""
    a, b = np.meshgrid(*[((np.arange(side) + 0.5) / side * 2 - 1) * half] * 2)
    count = side * side
    frame = np.stack([np.cross(u, v), u, v], axis=1)
    return FlatGaussians(
        (centre + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v).astype(np.float32),
        np.repeat(quaternions_from_matrices(frame[None]), count, axis=0).astype(np.float32),
        np.full((count, 2), np.log(2 * half / side), np.float32),
        np.full(count, 8.0, np.float32),
        np.tile((np.array(rgb, np.float32) - 0.5) / np.float32(SH_C0), (count, 1, 1)),
    )
