"""Residual colors: what materials and light do not explain of the photographs, by direction.

A split sum cannot show everything: what mirrors mirror a third time, shadows of a sun in the environment, or
texture finer than the materials. Once materials and light are learnt, what the photographs still differ by is
fitted with harmonics, everything else kept (:mod:`octasplat.engine.train.loop.residual_fit`). Pictures in the
learnt light add it. Relighting, edited materials and stages do not: it holds that light.

The residual color is a term of its own beside diffuse and specular ones in "GaussianShader"
(https://arxiv.org/abs/2311.17977); there it is learnt together with them.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.protocol import (
    LINEAR,
    ShadedRayGradients,
    ShadedRays,
    ShadingGradients,
    ShadingModel,
    TracedRays,
)
from octasplat.engine.shading.wrapper import WrapperModel
from octasplat.engine.trace.protocol import Tracer, TraceResult

ZERO_SRGB = np.float32(0.5)
"""Color that harmonics of zero have: the residual of a ray is what it shows less that."""

WHITE_FADE_SRGB = np.float32(0.3)
"""Residual colors below 0 by so much and more leave no radiance above white, less of them a part: the fit
sees white there, so that what it takes off would not be seen. Small ones are noise, and lamps stay bright."""


def with_residual(gaussians: FlatGaussians, residual_sh: Float32[np.ndarray, "n k 3"]) -> FlatGaussians:
    """Return Gaussians that show residual colors, in front of :data:`ZERO_SRGB`.

    Args:
        gaussians: the scene; its geometry is taken.
        residual_sh: harmonics of each Gaussian's residual color, display values.
    """
    return replace(gaussians, sh=residual_sh, channels=Channels())


def residual_of(result: TraceResult) -> Float32[np.ndarray, "r 3"]:
    """Return the residual colors along rays, premultiplied, of what Gaussians of :func:`with_residual` show.

    Those of one Gaussian are -0.5 at least.
    """
    return np.asarray(result.rgb_srgb - ZERO_SRGB * result.alpha[:, None], np.float32)


class ResidualColors(WrapperModel):
    """Add residual colors to what another model shades; not to be trained.

    Follows :class:`octasplat.engine.shading.protocol.ShadingModel`.

    Args:
        inner: the model of materials in the light that was learnt.
        scene: Gaussians that are shaded.
        residual_sh: harmonics of the residual color of each, display values.
        tracer: is built around these, and kept.

    Attributes:
        residual_sh: harmonics of the residual colors.
    """

    name = "residual"
    state_names: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        inner: ShadingModel,
        scene: FlatGaussians,
        residual_sh: Float32[np.ndarray, "n k 3"],
        tracer: Tracer,
    ) -> None:
        super().__init__(inner)
        tracer.build(with_residual(scene, residual_sh))
        self._tracer = tracer
        self.residual_sh = residual_sh

    def shade(self, traced: TracedRays) -> ShadedRays:
        """Return the colors of the inner model and the residual ones."""
        shaded, result = self.inner.shade(traced), self._tracer.trace(traced.rays)
        residual = residual_of(result)
        straight = residual / np.maximum(result.alpha, np.float32(1e-6))[:, None]
        return replace(
            shaded, rgb_srgb=shaded.rgb_srgb + residual, layers=with_residual_layers(shaded.layers, straight)
        )

    def backward(self, traced: TracedRays, shaded: ShadedRays, grad: ShadedRayGradients) -> ShadingGradients:
        """Return the gradients of the inner model."""
        return self.inner.backward(traced, shaded, grad)


def with_residual_layers(
    layers: Mapping[str, Float32[np.ndarray, "r _"]], residual_srgb: Float32[np.ndarray, "r 3"]
) -> Mapping[str, Float32[np.ndarray, "r _"]]:
    """Return the layers of a picture, whose radiance changes as what is shown of it does."""
    if LINEAR not in layers:
        return layers
    radiance = layers[LINEAR]
    white = np.minimum(radiance, np.float32(1))
    changed = srgb_to_linear(np.clip(linear_to_srgb(white) + residual_srgb, 0, 1))
    # what is brighter than white stays so, unless the photographs show less than white there
    kept = np.clip(1 + residual_srgb / WHITE_FADE_SRGB, 0, 1)
    return {**layers, LINEAR: np.asarray(changed + kept * (radiance - white), np.float32)}
