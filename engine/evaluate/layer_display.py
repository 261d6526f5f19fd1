"""Display colors for the layers of an image: normals, depths and materials."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.render.renderer import RenderedImage

MIN_ALPHA = 0.5
FAR_GRAY = 0.15
COVERAGE = "coverage"
"""Layer that shows how many training views see each place."""
LABELS: Mapping[str, str] = {
    "normal": "Normal",
    "depth": "Depth",
    "albedo": "Albedo",
    "metallic": "Metallic",
    "roughness": "Roughness",
    "visibility": "Visibility",
    "indirect": "Indirect",
    COVERAGE: "Coverage",
}
"""Layers by name, in the order in which they are offered."""


def display_layers(image: RenderedImage) -> dict[str, Float32[np.ndarray, "h w 3"]]:
    """Return the layers of an image as display values, black where alpha is 0.

    World normals go from -1 to 1 as colors from 0 to 1; what is near is bright, from the nearest to the
    farthest that is seen; albedo and indirect light are encoded, and everything else is shown as it is.
    """
    alpha = image.alpha[..., None]
    displays = {
        "normal": (image.normal_world + 1) / 2 * alpha,
        "depth": _to_gray(_depth_to_gray(image)) * alpha,
    }
    for name in LABELS:
        if name in image.layers:
            values = np.clip(image.layers[name], 0.0, 1.0)
            encoded = linear_to_srgb(values) if values.shape[2] == 3 else _to_gray(values[..., 0])
            displays[name] = encoded * alpha
    return {name: values.astype(np.float32) for name, values in displays.items()}


def display_environment(radiance_linear: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Return an environment map as display values, tone mapped by x / (1 + x)."""
    return linear_to_srgb(radiance_linear / (1 + radiance_linear))


def _depth_to_gray(image: RenderedImage) -> Float32[np.ndarray, "h w"]:
    visible_depths = image.depth[image.alpha >= MIN_ALPHA]
    if len(visible_depths) == 0:
        return np.zeros_like(image.depth)
    # Quantiles, as a few stray pixels must not take up the whole range
    near, far = np.quantile(visible_depths, (0.01, 0.99))
    place = np.clip((image.depth - near) / max(far - near, 1e-9), 0, 1)
    return np.asarray(1 - (1 - FAR_GRAY) * place, np.float32)


def _to_gray(values: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 3"]:
    return np.repeat(values[..., None], 3, axis=2)
