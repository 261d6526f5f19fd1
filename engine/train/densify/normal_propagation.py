"""Material-aware normal propagation: what reflects well hands its normal on to its neighbours.

A smooth metal shows by its reflections which way it faces, to a fraction of a degree; what is matt hardly
does. So now and then each Gaussian turns to the mean of the normals around it, in which those of smooth
metals count most. New Gaussians, which begin with the normal of the one they come from, find theirs that way.

The idea is that of "Reflective Gaussian Splatting" (https://arxiv.org/abs/2412.19282), whose code instead
raises all opacities, enlarges the Gaussians that reflect, and throws the colours of all others about by
chance; the ``seed`` recipe does that.
"""

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.spatial import cKDTree

from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.materials import ALBEDO, METALLIC, ROUGHNESS
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.shading.material_settings import (
    PROPAGATION_EVERY,
    PROPAGATION_UNTIL,
    REF_GAUSSIAN_DEFERRED_FROM,
    Recipe,
)
from octasplat.engine.trace.protocol import GaussianGradients
from octasplat.engine.train.densify.protocol import Densifier
from octasplat.engine.train.optimization.adam import Adam

NEIGHBOURS = 12
MIN_COSINE = 0.9
"""Normals farther apart belong to two surfaces."""
MAX_PLANE_DISTANCE = 0.3
"""Distance from a Gaussian's plane, of that to its neighbours, from which on another surface is likely."""
MAX_COLOR_DIFFERENCE = 0.15
"""Difference of albedo or metallic from which on another thing is likely."""
MIN_TRUST = 0.1
"""What a matt Gaussian's normal counts against 1 of a perfect mirror's."""
(
    REF_GAUSSIAN_OPACITY,
    REF_GAUSSIAN_GROWTH,
    REF_GAUSSIAN_METALLIC,
    REF_GAUSSIAN_ROUGHNESS,
    REF_GAUSSIAN_NOISE,
) = 0.9, 1.5, 0.02, 0.01, 0.4


class NormalPropagation:
    """Another strategy, with propagation now and then, after it.

    Args:
        inner: the strategy.
        recipe: how.
        iterations: of the whole training.
    """

    def __init__(self, inner: Densifier, recipe: Recipe, *, iterations: int) -> None:
        self.wants_errors = inner.wants_errors
        self._inner = inner
        self._recipe = recipe
        self._every = max(1, round(PROPAGATION_EVERY * iterations))
        self._until = PROPAGATION_UNTIL * iterations
        self._total = iterations
        self._iteration = 0

    def observe(
        self, count: int, gradients: GaussianGradients, mean_steps_world: Float32[np.ndarray, "u 3"]
    ) -> None:
        """The strategy inside takes note."""
        self._inner.observe(count, gradients, mean_steps_world)

    def is_due(self, iteration: int) -> bool:
        """When the strategy inside says so, or it is time to propagate."""
        self._iteration = iteration
        return self._inner.is_due(iteration) or self._is_due(iteration)

    def apply(
        self, gaussians: FlatGaussians, adam: Adam, rng: np.random.Generator, *, extent: float
    ) -> tuple[FlatGaussians, Adam]:
        """Do what is due."""
        iteration = self._iteration
        if self._inner.is_due(iteration):
            gaussians, adam = self._inner.apply(gaussians, adam, rng, extent=extent)
        if self._is_due(iteration) and len(gaussians) > NEIGHBOURS:
            if self._recipe == "ref_gaussian":
                self._propagate_ref_gaussian(gaussians, rng, training_progress=iteration / self._total)
            else:
                propagate_normals(gaussians)
        return gaussians, adam

    def reorder(self, order: Int64[np.ndarray, " n"]) -> None:
        """Tell the strategy inside."""
        self._inner.reorder(order)

    def state(self) -> dict[str, np.ndarray]:
        """That of the strategy inside."""
        return self._inner.state()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Take it back."""
        self._inner.restore(state)

    def _is_due(self, iteration: int) -> bool:
        return iteration <= self._until and iteration % self._every == 0

    def _propagate_ref_gaussian(
        self, gaussians: FlatGaussians, rng: np.random.Generator, *, training_progress: float
    ) -> None:
        """What the seed's code does."""
        raised = np.float32(np.log(REF_GAUSSIAN_OPACITY / (1 - REF_GAUSSIAN_OPACITY)))
        gaussians.opacity_logits[:] = np.maximum(gaussians.opacity_logits, raised)
        metallic = gaussians.channels[METALLIC][:, 0] >= REF_GAUSSIAN_METALLIC
        smooth = gaussians.channels[ROUGHNESS][:, 0] <= REF_GAUSSIAN_ROUGHNESS
        gaussians.log_scales[metallic & smooth] += np.float32(np.log(REF_GAUSSIAN_GROWTH))
        if training_progress >= REF_GAUSSIAN_DEFERRED_FROM:
            matt = np.flatnonzero(~metallic)
            noise = rng.uniform(-REF_GAUSSIAN_NOISE, REF_GAUSSIAN_NOISE, (len(matt), 3)) / SH_C0
            gaussians.sh[matt, 0] += noise.astype(np.float32)


def propagate_normals(gaussians: FlatGaussians) -> None:
    """Turn each Gaussian to the mean normal around it, in place; normals have no sign here.

    Neighbours count by opacity, nearness, likeness, and how well their material shows which way they face.
    """
    means = gaussians.means_world.astype(np.float64)
    frames = gaussians.rotations.astype(np.float64)
    normals = frames[:, :, 0]
    distances, near = cKDTree(means).query(means, NEIGHBOURS + 1)
    reach = np.maximum(distances[:, NEIGHBOURS // 2], 1e-12)[:, None]
    shown = gaussians.channels[METALLIC][:, 0] * (1 - gaussians.channels[ROUGHNESS][:, 0])
    trust = gaussians.opacities * (MIN_TRUST + shown)
    cosine = np.einsum("ni,nki->nk", normals, normals[near])
    off = np.einsum("ni,nki->nk", normals, means[near] - means[:, None]) / (MAX_PLANE_DISTANCE * reach)
    looks = (
        np.concatenate([gaussians.channels[ALBEDO], gaussians.channels[METALLIC]], axis=1)
        / MAX_COLOR_DIFFERENCE
    )
    unlike = ((looks[near] - looks[:, None]) ** 2).sum(axis=2)
    weights = trust[near] * np.exp(-0.5 * ((distances / reach) ** 2 + off**2 + unlike))
    weights = np.where(np.abs(cosine) > MIN_COSINE, weights, 0.0) * np.sign(cosine)
    mean = np.einsum("nk,nki->ni", weights, normals[near])
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    mean = np.where(length > 0, mean / np.maximum(length, 1e-12), normals)
    turned = np.einsum("nij,njk->nik", _rotations_between(normals, mean), frames)
    gaussians.quats_wxyz[:] = quaternions_from_matrices(turned).astype(np.float32)


def _rotations_between(
    before: Float64[np.ndarray, "n 3"], after: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3 3"]:
    """The smallest rotations that take unit vectors to others which are not opposite to them."""
    axis = np.cross(before, after)
    cosine = (before * after).sum(axis=1)
    cross = np.zeros((len(before), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    cross -= cross.transpose(0, 2, 1)
    return np.eye(3) + cross + (cross @ cross) / (1 + cosine)[:, None, None]
