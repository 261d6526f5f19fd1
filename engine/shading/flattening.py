"""A model whose scene is to become one surface: normals agree with depths, whatever colours say.

Each Gaussian is flat and has a normal; what the depths of neighbouring rays span has one, too. Photographs
alone let the two differ, so that a surface made of the depths is rough. Follows the depth-normal consistency
of "2D Gaussian Splatting for Geometrically Accurate Radiance Fields" (https://arxiv.org/abs/2403.17888), with
neighbours in a window of a batch where that has neighbouring pixels.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from engine.gaussians.model import FlatGaussians
from engine.shading.geometry_terms import depth_normal_term
from engine.shading.plain import PLAIN
from engine.shading.protocol import Developed, Reversed, ShadingModel, Sight
from engine.trace.protocol import GaussianGradients, Tracer


class Flattening:
    """Develops as the model inside, and holds normals and depths together while that is trained.

    Follows :class:`engine.shading.protocol.ShadingModel`. The term is one minus the cosine between a ray's
    blended normal and that of the points of three neighbouring rays, a mean over the rays.

    Args:
        weight: of the term.
        window_rays: rays of each window of a batch, in which windows come last.
        inner: the model whose colours are compared with photographs, without geometry gradients of its own.
    """

    name = "flattening"

    def __init__(self, weight: float, *, window_rays: int, inner: ShadingModel = PLAIN) -> None:
        self._weight = weight
        self._window_rays = window_rays
        self.inner = inner

    def features(self, gaussians: FlatGaussians) -> Float32[np.ndarray, "n f"] | None:
        """Those of the model inside."""
        return self.inner.features(gaussians)

    def settle(self, gaussians: FlatGaussians, tracer: Tracer, *, progress: float) -> None:
        """The model inside looks around."""
        self.inner.settle(gaussians, tracer, progress=progress)

    def develop(self, sight: Sight) -> Developed:
        """As the model inside."""
        return self.inner.develop(sight)

    def reverse(
        self,
        sight: Sight,
        developed: Developed,
        by_rgb: Float32[np.ndarray, "r 3"],
        by_transmittance: Float32[np.ndarray, " r"],
    ) -> Reversed:
        """The gradients of the model inside, and those of the term by alphas, depths and normals."""
        below = self.inner.reverse(sight, developed, by_rgb, by_transmittance)
        count = len(by_rgb)
        by_alpha, by_normal, by_depth = np.zeros(count), np.zeros((count, 3)), np.zeros(count)
        depth_normal_term(sight, self._window_rays, self._weight, by_alpha, by_normal, by_depth)
        transmittance = -by_alpha
        if below.seen.transmittance is not None:
            transmittance += below.seen.transmittance
        seen = replace(
            below.seen,
            transmittance=transmittance.astype(np.float32),
            depth_sum=by_depth.astype(np.float32),
            normal_world=by_normal.astype(np.float32),
        )
        return replace(below, seen=seen)

    def step(
        self,
        gaussians: FlatGaussians,
        gradients: GaussianGradients,
        parameters: Mapping[str, np.ndarray],
        *,
        progress: float,
    ) -> None:
        """That of the model inside."""
        self.inner.step(gaussians, gradients, parameters, progress=progress)

    def state(self) -> dict[str, np.ndarray]:
        """What the model inside keeps."""
        return self.inner.state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Give it back to the model inside."""
        self.inner.restore(state)
