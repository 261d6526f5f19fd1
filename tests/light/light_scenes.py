"""Stages and cameras for the tests of the path tracer."""

from pathlib import Path

import numpy as np

from engine.light.film import Film
from engine.light.integrator import LitScene, PathTracer
from engine.light.stage import Stage
from engine.light.staging import stage_meshes
from engine.render.cameras import RenderCamera, focal_from_fov

UP = (0.0, -1.0, 0.0)


def camera(
    eye: tuple[float, ...], target: tuple[float, ...], size: tuple[int, int] = (64, 48), fov: float = 45.0
) -> RenderCamera:
    """A camera that looks from one point to another, with -y up; the field of view is from top to bottom."""
    forward = np.array(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, UP)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return RenderCamera.from_pose(pose, *size, fy_px=focal_from_fov(fov, size[1]))


def film_of(
    stage: Stage,
    view: RenderCamera,
    folder: Path = Path(),
    *,
    background: float = 0.0,
    threads: int = 2,
) -> Film:
    """Render a stage without Gaussians."""
    scene = LitScene(stage_meshes(stage, folder, threads=threads), None, np.full(3, background))
    return PathTracer(scene, stage.integrator, threads=threads).render(view.rays())


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Decibels between two pictures of values up to 1."""
    error = float(np.mean((a.astype(np.float64) - b) ** 2))
    return float("inf") if error == 0 else -10 * np.log10(error)
