"""The path tracer's BSDFs over arrays of directions, as the tests ask them.

Directions are unit vectors in the frame of the shading normal (z): ``to_viewer`` and ``to_light``.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

from octasplat.engine.pathtracing.bsdf_tables import albedo_table
from octasplat.engine.pathtracing.kernels.kernel_args import AlbedoTables
from octasplat.engine.pathtracing.kernels.principled_bsdf import BURLEY, COUPLED
from octasplat.engine.pathtracing.kernels.principled_bsdf_arrays import (
    BsdfArrays,
    fresnel_values,
    principled_eval_array,
    principled_sample_array,
)
from octasplat.engine.pathtracing.kernels.rough_dielectric import (
    rough_dielectric_eval_array,
    rough_dielectric_sample_array,
)


@dataclass(frozen=True)
class RoughGlass:
    """A surface of rough glass; ``to_light`` lies on either side of it.

    Attributes:
        eta: index of refraction on the far side over that on the viewer's.
        roughness: perceptual; GGX's alpha is its square.
    """

    eta: float
    roughness: float

    def evaluate(
        self, to_viewer: Float64[np.ndarray, "n 3"], to_light: Float64[np.ndarray, "n 3"]
    ) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
        """Values of basic radiance times the cosine to the light, and the density of :meth:`sample`."""
        values, pdf = np.empty((2, len(to_viewer)))
        rough_dielectric_eval_array(
            0, len(values), to_viewer, to_light, self.eta, self.roughness**2, values, pdf
        )
        return values, pdf

    def sample(
        self, to_viewer: Float64[np.ndarray, "n 3"], uniform: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Directions to the light from three numbers in [0, 1) each."""
        to_light = np.empty((len(to_viewer), 3))
        rough_dielectric_sample_array(
            0, len(to_light), to_viewer, self.eta, self.roughness**2, uniform, to_light
        )
        return to_light


@dataclass(frozen=True)
class OpaqueMaterial:
    """A mixture of metal and of a diffuse substrate under a clear coat, ``n`` points of it.

    Attributes:
        colors_linear: of the substrate, and of the metal head-on.
        metallic: share of the metal.
        roughness: perceptual; GGX's alpha is its square.
        ior: index of refraction of the coat.
        substrate: ``coupled`` keeps all energy; ``burley`` is Disney's diffuse term.
        multiple_scattering: whether light that the metal's facets reflect to each other is kept.
        clear_coat: share of the surface under a clear coat.
        clear_coat_roughness: perceptual.
    """

    colors_linear: Float64[np.ndarray, "n 3"]
    metallic: Float64[np.ndarray, " n"]
    roughness: Float64[np.ndarray, " n"]
    ior: float = 1.5
    substrate: Literal["coupled", "burley"] = "coupled"
    multiple_scattering: bool = True
    clear_coat: float = 0.0
    clear_coat_roughness: float = 0.0

    def evaluate(
        self, to_viewer: Float64[np.ndarray, "n 3"], to_light: Float64[np.ndarray, "n 3"]
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
        """Values times the cosine to the light, and the density of :meth:`sample` over solid angle."""
        values, pdf = np.empty((len(to_viewer), 3)), np.empty(len(to_viewer))
        bsdf, tables = self._arrays(), self._tables()
        principled_eval_array(0, len(values), to_viewer, to_light, bsdf, tables, values, pdf)
        return values, pdf

    def sample(
        self, to_viewer: Float64[np.ndarray, "n 3"], uniform: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Directions to the light from three numbers in [0, 1) each; some lie below the surface."""
        to_light = np.empty((len(to_viewer), 3))
        bsdf, tables = self._arrays(), self._tables()
        principled_sample_array(0, len(to_light), to_viewer, bsdf, tables, uniform, to_light)
        return to_light

    def _arrays(self) -> BsdfArrays:
        substrate = BURLEY if self.substrate == "burley" else COUPLED
        return BsdfArrays(
            self.colors_linear, self.metallic, self.roughness, self.ior, substrate, self.multiple_scattering,
            self.clear_coat, self.clear_coat_roughness,
        )  # fmt: skip

    def _tables(self) -> AlbedoTables:
        coat, clear_coat = albedo_table(self.ior), albedo_table(1.5).directional
        return AlbedoTables(albedo_table(None).directional, coat.directional, coat.mean, clear_coat)


def fresnel(
    cosines: Float64[np.ndarray, " n"], eta: float
) -> tuple[Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Reflected share and cosine of the refracted ray at a smooth surface.

    Args:
        cosines: of the arriving ray to the normal, not negative.
        eta: index of refraction on the far side over that on the near side.
    """
    reflected, cos_t = np.empty(len(cosines)), np.empty(len(cosines))
    fresnel_values(cosines, eta, reflected, cos_t)
    return reflected, cos_t
