"""The film: sums over paths per pixel, and the image that they make.

A pixel has a front layer of Gaussians (premultiplied display color, transmittance, and the factor that the
stage's lights give to it) and linear light behind it; for the reason see
:mod:`octasplat.engine.pathtracing.kernels.gaussian_layer`.

Visible Gaussians with materials are summed and encoded separately, so that their edges blend in display
values as photographs with alpha do.

The compositing layers are such that ``background * shadow`` under ``things`` (the stage's meshes) is the
image again. Meshes and scene are blended in display values in the image, but in linear ones in a compositor:
in a partly covered pixel, the alpha of the meshes is increased by what this takes, so that no value is
negative.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.pathtracing.kernels.film import FilmArrays, add_paths, allocate_film
from octasplat.engine.pathtracing.kernels.path_args import PathArrays

ToneCurve = Literal["none", "reinhard", "filmic"]
DenoiseFn = Callable[
    [Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"] | None, Float32[np.ndarray, "h w 3"] | None],
    Float32[np.ndarray, "h w 3"],
]
"""Takes noise from a linear image, guided by the colors and normals of surfaces where they are given."""
_NO_SUMS = allocate_film(0)
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_DARK = 1e-6
PIXELS_AT_ONCE = 1 << 16
"""An image is made of so many pixels at a time: what is worked out on the way takes 300 bytes for each."""


@dataclass(frozen=True)
class StageImage:
    """One image of a stage.

    Attributes:
        rgb_srgb: display values after exposure and tone curve, clipped to [0, 1].
        rgb_linear: linear values before both, not clipped.
        alpha: 1 less what is seen of the background behind everything.
        layers: what a compositor needs, linear channels by name: ``background``, ``shadow`` and ``things``,
            each with R, G, B, A; nothing unless they were asked for.
    """

    rgb_srgb: Float32[np.ndarray, "h w 3"]
    rgb_linear: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"]
    layers: dict[str, Float32[np.ndarray, "h w"]]


class Film:
    """Sums over the paths of each pixel, in float64 and in a fixed order.

    Args:
        height: of the picture, pixels.
        width: of the picture, pixels.
        has_layers: also keep what the layers of a compositor need.
        has_guides: also keep what :meth:`denoised` needs.

    Attributes:
        plate: the scene alone, to be filled alongside; None unless ``has_layers``.
    """

    def __init__(
        self, height: int, width: int, *, has_layers: bool = False, has_guides: bool = False
    ) -> None:
        self._shape = (height, width)
        self._sums = allocate_film(height * width, has_guides=has_guides)
        self.plate = Film(height, width) if has_layers else None
        self._without_meshes = Film(height, width) if has_layers else None

    @property
    def sums(self) -> FilmArrays:
        """Return the sums, for kernels."""
        return self._sums

    @property
    def sums_without_meshes(self) -> FilmArrays:
        """Return the sums of paths that meet no mesh, for kernels; no rows where the film keeps none."""
        return _NO_SUMS if self._without_meshes is None else self._without_meshes.sums

    def add(self, paths: PathArrays, pixels: Int64[np.ndarray, " n"]) -> None:
        """Add finished paths, equally many for each of ``pixels``, those of one pixel consecutive."""
        each = len(paths.keys) // len(pixels)
        left_out = np.zeros(len(pixels), np.bool_)
        add_paths(len(pixels), paths, each, pixels, 0, self.sums, self.sums_without_meshes, left_out)

    def gaussian_surface(self) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Return the mean linear radiance of the visible Gaussians with materials, and their coverage."""
        linear = _safe_divide(self._sums.front_linear, self._sums.front[:, None])
        coverage = self._sums.front / np.maximum(self._sums.samples, 1)
        return linear.astype(np.float32).reshape(*self._shape, 3), coverage.astype(np.float32).reshape(
            self._shape
        )

    def image(
        self, *, exposure: float = 0.0, tone: ToneCurve = "none", transparent: bool = False
    ) -> StageImage:
        """Return the image of all paths so far.

        Args:
            exposure: in stops.
            tone: curve of the display values.
            transparent: the background is black and stands for nothing: display values are those of what
                covers it, not multiplied by alpha, and linear values are multiplied by alpha.
        """
        height, width = self._shape
        rows_at_once = max(1, PIXELS_AT_ONCE // max(width, 1))
        whole = StageImage(
            np.empty((height, width, 3), np.float32),
            np.empty((height, width, 3), np.float32),
            np.empty((height, width), np.float32),
            {},
        )
        for top in range(0, height, rows_at_once):
            rows = slice(top, min(top + rows_at_once, height))
            part = self._rows(rows)._image_together(exposure, tone, transparent)
            whole.rgb_srgb[rows], whole.rgb_linear[rows] = part.rgb_srgb, part.rgb_linear
            whole.alpha[rows] = part.alpha
            for name, values in part.layers.items():
                whole.layers.setdefault(name, np.empty((height, width), np.float32))[rows] = values
        return whole

    def _rows(self, rows: slice) -> "Film":
        """Return a film of some rows, which shares their sums with this one."""
        film, width = copy.copy(self), self._shape[1]
        film._shape = (rows.stop - rows.start, width)
        pixels = slice(rows.start * width, rows.stop * width)
        film._sums = FilmArrays(*(sums[pixels] for sums in self._sums))
        film.plate = None if self.plate is None else self.plate._rows(rows)
        film._without_meshes = None if self._without_meshes is None else self._without_meshes._rows(rows)
        return film

    def _image_together(self, exposure: float, tone: ToneCurve, transparent: bool) -> StageImage:
        linear, alpha = self._linear_radiance(), self._alpha()
        layers = self._mesh_layers(linear)
        if transparent:
            linear = self._linear_radiance(of_covered=True)
        display = linear_to_srgb(apply_tone_curve(linear * 2.0**exposure, tone))
        return StageImage(
            np.clip(display, 0.0, 1.0).astype(np.float32).reshape(*self._shape, 3),
            self._to_image(alpha[:, None] * linear if transparent else linear),
            self._to_image(alpha),
            layers,
        )

    def denoised(self, denoise: DenoiseFn) -> "Film":
        """Return the film with its lit part denoised; the Gaussians' own colors stay as they are."""
        film = copy.copy(self)
        count = np.maximum(self._sums.samples, 1)[:, None]
        if self._sums.mesh_visibility.any():
            guides = (
                self._to_image(self._sums.albedo_linear / count),
                self._to_image(self._sums.normals_world / count),
            )
            light = denoise(self._to_image(self._sums.light_linear / count), *guides)
            smooth = light.reshape(-1, 3).astype(np.float64) * count
            # the noise-free background behind no mesh stays
            is_mesh = self._sums.mesh_visibility[:, None] > 0.0
            film._sums = film._sums._replace(light_linear=np.where(is_mesh, smooth, self._sums.light_linear))
        covered = self._covered()
        shade = _safe_divide(self._sums.shading, covered, 1.0)
        if (np.abs(shade - 1.0) > _DARK).any():
            even = denoise(self._to_image(np.maximum(shade, 0.0)), None, None)
            film._sums = film._sums._replace(shading=even.reshape(-1, 3).astype(np.float64) * covered)
        if self._without_meshes is not None:
            film._without_meshes = self._without_meshes.denoised(denoise)
        return film

    def _alpha(self) -> Float64[np.ndarray, " n"]:
        return np.asarray(self._sums.coverage / np.maximum(self._sums.samples, 1))

    def _linear_radiance(self, *, lit: bool = True, of_covered: bool = False) -> Float64[np.ndarray, "n 3"]:
        """Return linear values; without ``lit`` those of the Gaussians as trained.

        ``of_covered`` gives the values of what covers a black background, as if it did so fully.
        """
        count = np.maximum(self._sums.samples, 1)[:, None]
        through, front = self._sums.transmittance[:, None] / count, self._sums.front[:, None] / count
        covered = np.maximum(1.0 - through - front, 0.0)
        layer = self._sums.layer_srgb / count
        light = _safe_divide(self._sums.light_linear, self._sums.transmittance[:, None])
        if of_covered:
            # all light behind the layer comes from what covers the background
            through = np.maximum(self._alpha()[:, None] - covered - front, 0.0)
            light = _safe_divide(self._sums.light_linear / count, through)
        surface = _safe_divide(self._sums.front_linear, self._sums.front[:, None])
        if lit:
            shade = _safe_divide(self._sums.shading, self._covered(), 1.0)
            # linear light is scaled, display values would change hue
            color = srgb_to_linear(_safe_divide(layer, covered)) * np.maximum(shade, 0.0)
            # an unlit color is not rounded twice
            layer = np.where(np.abs(shade - 1.0) < 1e-6, layer, covered * linear_to_srgb(color))
        display = layer + front * linear_to_srgb(surface) + through * linear_to_srgb(light)
        if of_covered:
            display = _safe_divide(display, self._alpha()[:, None])
        return np.asarray(srgb_to_linear(display))

    def _covered(self) -> Float64[np.ndarray, "n 1"]:
        return (self._sums.samples - self._sums.transmittance - self._sums.front)[:, None]

    def _mesh_layers(self, picture: Float64[np.ndarray, "n 3"]) -> dict[str, Float32[np.ndarray, "h w"]]:
        if self._without_meshes is None or self.plate is None:
            return {}
        plain = self._without_meshes._linear_radiance(lit=False)
        # where the plain image is dark the ratio would be noise: no shadow there
        is_lit = (self._without_meshes._sums.samples > 0)[:, None] & (plain > _DARK)
        shadow = np.where(is_lit, self._without_meshes._linear_radiance() / np.where(is_lit, plain, 1.0), 1.0)
        background = self.plate._linear_radiance(lit=False)
        behind = background * shadow
        alpha = self._sums.mesh_visibility / np.maximum(self._sums.samples, 1)
        # the least alpha for which picture - (1 - alpha) behind is not negative
        needed = np.where(behind > _DARK, 1.0 - picture / np.maximum(behind, _DARK), 0.0).max(axis=1)
        alpha = np.where(alpha > 0.0, np.clip(np.maximum(alpha, needed), 0.0, 1.0), 0.0)[:, None]
        mesh_light = np.where(alpha > 0.0, np.maximum(picture - (1.0 - alpha) * behind, 0.0), 0.0)
        beyond = self.plate._sums.coverage / np.maximum(self.plate._sums.samples, 1)
        parts = {
            "background": (background, beyond),
            "shadow": (shadow, np.clip(1.0 - shadow.mean(axis=1), 0.0, 1.0)),
            "things": (mesh_light, alpha[:, 0]),
        }
        channels: dict[str, Float32[np.ndarray, "h w"]] = {}
        for name, (rgb, a) in parts.items():
            channels |= {f"{name}.{c}": self._to_image(rgb[:, k]) for k, c in enumerate("RGB")}
            channels[f"{name}.A"] = self._to_image(a)
        return channels

    def _to_image(self, values: Float64[np.ndarray, "n *c"]) -> Float32[np.ndarray, "h w *c"]:
        return values.astype(np.float32).reshape(*self._shape, *values.shape[1:])


def apply_tone_curve(linear: Float64[np.ndarray, "n 3"], tone: ToneCurve) -> Float64[np.ndarray, "n 3"]:
    """Return linear values under a tone curve; only ``filmic`` limits them to [0, 1].

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


def _safe_divide(
    values: Float64[np.ndarray, "n 3"], by: Float64[np.ndarray, "n 1"], otherwise: float = 0.0
) -> Float64[np.ndarray, "n 3"]:
    return np.where(by > 1e-9, values / np.maximum(by, 1e-9), otherwise)
