"""What paths gathered, pixel by pixel, and the picture that it makes.

A pixel has a front layer of Gaussians (premultiplied display colour, transmittance, and the factor that the
stage's lights give to it) and linear light behind it; see :mod:`engine.light.kernels_layer` for the reason.
Gaussians with materials that the camera sees are a part of the pixel of their own, encoded by itself, so that
their edges blend in display values as photographs with alpha do.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int64

from engine.colour import linear_to_srgb, srgb_to_linear
from engine.light.arrays import Paths
from engine.light.kernels_film import add_up
from engine.light.kernels_scatter import FRONT

Tone = Literal["none", "reinhard", "filmic"]
_ONE = np.empty(0, np.float32)
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class StageImage:
    """One picture of a stage.

    Attributes:
        rgb_srgb: display values after exposure and tone curve, clipped to [0, 1].
        rgb_linear: linear values before both, not clipped.
        alpha: 1 less what is seen of the background behind everything.
    """

    rgb_srgb: Float32[np.ndarray, "h w 3"]
    rgb_linear: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"]


class Film:
    """Sums over the paths of each pixel, in float64 and in a fixed order.

    Args:
        height: of the picture, pixels.
        width: of the picture, pixels.
    """

    def __init__(self, height: int, width: int) -> None:
        self._shape = (height, width)
        count = height * width
        self._layer, self._light, self._shade = np.zeros((3, count, 3))
        self._through, self._coverage, self._samples, self._front = np.zeros((4, count))
        self._front_light = np.zeros((count, 3))

    def add(self, paths: Paths, pixels: Int64[np.ndarray, " n"]) -> None:
        """Add finished paths, equally many to each of ``pixels``, those of one pixel beside each other."""
        each = len(paths.keys) // len(pixels)

        def add(
            sums: Float64[np.ndarray, "..."],
            values: Float32[np.ndarray, "..."],
            factors: Float32[np.ndarray, " f"] = _ONE,
        ) -> None:
            add_up(values.reshape(len(values), -1), factors, each, pixels, sums.reshape(len(sums), -1))

        front = (paths.marks & FRONT != 0).astype(np.float32)
        through = paths.transmittance * (1 - front)
        add(self._layer, paths.layer_srgb)
        add(self._light, paths.radiance_linear, through)
        add(self._shade, paths.shade)
        add(self._through, through)
        add(self._coverage, paths.coverage)
        add(self._front, front)
        add(self._front_light, paths.radiance_linear, front)
        self._samples[pixels] += each

    def surface(self) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Mean linear radiance of the Gaussians with materials that the camera sees, and their coverage."""
        linear = _divided(self._front_light, self._front[:, None])
        coverage = self._front / np.maximum(self._samples, 1)
        return linear.astype(np.float32).reshape(*self._shape, 3), coverage.astype(np.float32).reshape(
            self._shape
        )

    def image(self, *, exposure: float = 0.0, tone: Tone = "none") -> StageImage:
        """The picture of all paths so far; ``exposure`` is in stops."""
        count = np.maximum(self._samples, 1)[:, None]
        through = self._through[:, None] / count
        front = self._front[:, None] / count
        covered = np.maximum(1.0 - through - front, 0.0)
        layer = self._layer / count
        light = _divided(self._light, self._through[:, None])
        shade = _divided(self._shade, (self._samples - self._through - self._front)[:, None], 1.0)
        surface = _divided(self._front_light, self._front[:, None])
        colour = srgb_to_linear(_divided(layer, covered)) * np.maximum(shade, 0.0)
        lit = np.where(np.abs(shade - 1.0) < 1e-6, layer, covered * linear_to_srgb(colour))
        linear = srgb_to_linear(lit + front * linear_to_srgb(surface) + through * linear_to_srgb(light))
        shown = linear_to_srgb(toned(linear * 2.0**exposure, tone))
        return StageImage(
            np.clip(shown, 0.0, 1.0).astype(np.float32).reshape(*self._shape, 3),
            linear.astype(np.float32).reshape(*self._shape, 3),
            (self._coverage / count[:, 0]).astype(np.float32).reshape(self._shape),
        )


def toned(linear: Float64[np.ndarray, "n 3"], tone: Tone) -> Float64[np.ndarray, "n 3"]:
    """Linear values brought into [0, 1] by a tone curve.

    ``reinhard`` divides by 1 plus luminance ("Photographic Tone Reproduction", Reinhard et al. 2002);
    ``filmic`` is a fit of ACES' reference curve (https://knarkowicz.wordpress.com, "ACES Filmic Tone Mapping
    Curve", 2016).
    """
    if tone == "reinhard":
        return linear / (1.0 + linear @ _LUMINANCE)[:, None]
    if tone == "filmic":
        x = 0.6 * linear
        return np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)
    return linear


def _divided(
    values: Float64[np.ndarray, "n 3"], by: Float64[np.ndarray, "n 1"], otherwise: float = 0.0
) -> Float64[np.ndarray, "n 3"]:
    return np.where(by > 1e-9, values / np.maximum(by, 1e-9), otherwise)
