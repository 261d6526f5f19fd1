"""A model whose scene is to become one surface: normals agree with depths, whatever colors say.

Each Gaussian is flat and has a normal; what the depths of neighbouring rays span has one, too. Photographs
alone let the two differ, so that a surface made of the depths is rough. Follows the depth-normal consistency
of "2D Gaussian Splatting for Geometrically Accurate Radiance Fields" (https://arxiv.org/abs/2403.17888), with
neighbours in a patch of a batch where that has neighbouring pixels.
"""

from dataclasses import replace

import numpy as np

from octasplat.engine.shading.geometry_losses import add_depth_normal_gradient
from octasplat.engine.shading.plain import PlainShading
from octasplat.engine.shading.protocol import ShadedRayGradients, ShadedRays, ShadingGradients, TracedRays


class DepthNormalShading(PlainShading):
    """Shade as the plain model, and regularise normals by depths.

    The term is one minus the cosine between a ray's blended normal and that of the points of three
    neighbouring rays, a mean over the rays.

    Args:
        weight: of the term.
    """

    name = "flattening"

    def __init__(self, weight: float) -> None:
        self._weight = weight

    def backward(self, traced: TracedRays, shaded: ShadedRays, grad: ShadedRayGradients) -> ShadingGradients:
        """Return the gradients of the plain model, and those of the term by alphas, depths and normals."""
        plain = super().backward(traced, shaded, grad)
        count = len(grad.rgb_srgb)
        grad_alpha, grad_normal, grad_depth = np.zeros(count), np.zeros((count, 3)), np.zeros(count)
        add_depth_normal_gradient(traced, self._weight, grad_alpha, grad_normal, grad_depth)
        grad_trace = replace(
            plain.trace,
            transmittance=(grad.transmittance - grad_alpha).astype(np.float32),
            depth_sum=grad_depth.astype(np.float32),
            normal_world=grad_normal.astype(np.float32),
        )
        return replace(plain, trace=grad_trace)
