"""Training for a surface: normals and depths are held together, by the gradient of the term that is named."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.shading.depth_normal_model import DepthNormalShading
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import ShadedRayGradients, TracedRays
from octasplat.engine.shading.ray_patches import RayPatches
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceResult
from octasplat.engine.train.loop.state import initial_state
from octasplat.engine.train.loop.trainer import Trainer
from tests.support.planar_dataset import PlanarDataset, small_config

SIDE, WINDOWS, LOOSE = 4, 3, 5
COUNT = LOOSE + WINDOWS * SIDE**2
CELLS = [0, 1, 4, 5, 2, 3, 6, 7, 8, 9, 12, 13, 10, 11, 14, 15]
"""The cell of each ray of a window, cells counted row by row: along a Z."""


def wavy() -> TracedRays:
    """A few loose rays, then windows on a wavy surface with normals that do not quite fit, and a hole."""
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, SIDE), np.linspace(-0.3, 0.3, SIDE))
    across = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)[CELLS]
    directions = np.concatenate([rng.normal((0, 0, 1), 0.1, (LOOSE, 3)), *[across] * WINDOWS])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    depth = 2 + 0.1 * np.sin(9 * directions[:, 0]) + 0.02 * rng.random(COUNT)
    transmittance = rng.uniform(0.0, 0.08, COUNT)
    transmittance[LOOSE + 6] = 0.5
    alpha = 1 - transmittance
    normals = rng.normal(0, 0.2, (COUNT, 3)) - [0, 0, 1]
    numbers = (np.zeros((COUNT, 3)), transmittance, alpha * depth, depth, alpha[:, None] * normals)
    narrow = [number.astype(np.float32) for number in (*numbers, np.zeros((COUNT, 0)))]
    seen = TraceResult(*narrow, np.ones(COUNT, np.int32))
    rays = RayBatch(np.zeros((1, 3)), directions)
    windows = RayPatches(LOOSE, WINDOWS, SIDE)
    return TracedRays(rays, seen, CpuTracer(), np.zeros(COUNT, np.int64), ray_patches=windows)


def term(
    directions: torch.Tensor, alpha: torch.Tensor, depth_sum: torch.Tensor, normals: torch.Tensor
) -> torch.Tensor:
    """The sum over windows as it is defined, of rays whose three points are of one opaque surface."""
    total = torch.zeros((), dtype=torch.float64)
    points = directions * (depth_sum / alpha)[:, None]
    for first in range(LOOSE, COUNT, SIDE**2):
        for row in range(SIDE - 1):
            for column in range(SIDE - 1):
                cell = row * SIDE + column
                three = [first + CELLS.index(k) for k in (cell, cell + 1, cell + SIDE)]
                here = three[0]
                if not all(alpha[k] > 0.9 for k in three):
                    continue
                spanned = torch.linalg.cross(points[three[1]] - points[here], points[three[2]] - points[here])
                spanned = spanned / spanned.norm()
                spanned = spanned if spanned @ directions[here] < 0 else -spanned
                if -(spanned @ directions[here]) > 0.15:
                    total = total + 1 - spanned @ normals[here] / normals[here].norm()
    return total


def test_gradients_are_those_of_the_term_and_of_the_model_inside() -> None:
    sight, weight = wavy(), 0.3
    seen = sight.result
    rng = np.random.default_rng(4)
    grad_rgb, grad_transmittance = rng.normal(size=(COUNT, 3)), rng.normal(size=COUNT)
    grad = ShadedRayGradients(grad_rgb.astype(np.float32), grad_transmittance.astype(np.float32))
    model = DepthNormalShading(weight)
    found = model.backward(sight, model.shade(sight), grad).trace

    wide = (seen.alpha, seen.depth_sum, seen.normal_world)
    alpha, depth, normals = (torch.tensor(x.astype(np.float64), requires_grad=True) for x in wide)
    value = (
        weight
        * term(torch.tensor(sight.rays.directions_world, dtype=torch.float64), alpha, depth, normals)
        / COUNT
    )
    value.backward()
    assert value > 0.001
    inside = PLAIN_SHADING.backward(sight, PLAIN_SHADING.shade(sight), grad).trace
    assert np.array_equal(found.rgb_srgb, inside.rgb_srgb)
    assert found.depth_sum == pytest.approx(depth.grad.numpy(), abs=1e-5)
    assert found.normal_world == pytest.approx(normals.grad.numpy(), abs=1e-5)
    assert found.transmittance - grad.transmittance == pytest.approx(-alpha.grad.numpy(), abs=1e-5)


def tilted(world: PlanarDataset) -> FlatGaussians:
    """Gaussians on the plane, each turned out of it."""
    gaussians = world.initial_gaussians(opacity=0.9)
    turns = np.random.default_rng(5).normal(0, 0.15, (len(gaussians), 4))
    gaussians.quats_wxyz += turns.astype(np.float32)
    return gaussians


def test_tilted_gaussians_lie_down_on_the_plane(tmp_path: Path) -> None:
    world = PlanarDataset()

    def off_degrees(weight: float) -> float:
        config = small_config(loss={"depth_normal": weight}, rays_per_batch=2048, ray_patch_rays=16)
        trainer = Trainer(
            world, config, initial_state(tilted(world), 0), folder=tmp_path, fingerprint=str(weight),
            progress=lambda _event: None, threads=1,
        )  # fmt: skip
        trained = trainer.run()
        solid = trained.opacities > 0.5
        return math.degrees(np.arccos(np.abs(trained.rotations[solid, 2, 0]).clip(0, 1)).mean())

    held, free = off_degrees(0.1), off_degrees(0.0)
    assert held < 0.9 * free, (held, free)


def test_settings_without_neighbours_are_refused() -> None:
    with pytest.raises(ConfigError, match="set ray_patch_rays to 64"):
        resolve_config("fast", assignments=["loss.depth_normal=0.05", "ray_patch_rays=1"])
    resolve_config("fast", assignments=["loss.depth_normal=0.05", "loss.ssim=0.2"])
    resolve_config("fast", materials=True, assignments=["loss.depth_normal=0.05", "ray_patch_rays=1"])
