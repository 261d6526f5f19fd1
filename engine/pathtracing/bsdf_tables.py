"""Materials on arrays: how much light of one direction leaves in another, samples, and their densities.

Directions are unit vectors in the frame of the shading normal (z): ``to_viewer`` and ``to_light``. All is
linear and a pure function of the arguments, in float64, so that gradients can be taken alongside.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numba
import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.pathtracing.kernels.kernel_args import AlbedoTables
from octasplat.engine.pathtracing.kernels.principled_bsdf import BURLEY, COUPLED
from octasplat.engine.pathtracing.kernels.principled_bsdf_arrays import (
    BsdfArrays,
    fresnel_values,
    integrate_albedo,
    principled_eval_array,
    principled_sample_array,
)
from octasplat.engine.pathtracing.kernels.rough_dielectric import (
    integrate_rough_dielectric,
    rough_dielectric_eval_array,
    rough_dielectric_sample_array,
)

TABLE_ROUGHNESSES = 32
TABLE_COSINES = 64
TABLE_SAMPLES = 512


@dataclass(frozen=True)
class AlbedoTable:
    """Share of light from a direction that one bounce off GGX facets sends back.

    Attributes:
        directional: rows are roughness 0 to 1, columns the cosine of the direction 0 to 1.
        mean: cosine-weighted mean over all directions, a row a roughness; its two columns are the same.
    """

    directional: Float64[np.ndarray, "a c"]
    mean: Float64[np.ndarray, "a 2"]


@lru_cache(maxsize=64)
def albedo_table(ior: float | None) -> AlbedoTable:
    """The table of a dielectric's surface, or of facets that reflect everything where ``ior`` is None."""
    table = np.empty((TABLE_ROUGHNESSES, TABLE_COSINES))
    run_ranges(
        integrate_albedo, numba.get_num_threads(), len(table),
        0.0 if ior is None else ior, TABLE_SAMPLES, table, grain=1,
    )  # fmt: skip
    cosines = np.linspace(0.0, 1.0, TABLE_COSINES)
    # The table is linear between its columns; Simpson's rule is exact for that times the cosine.
    middles = 0.5 * (cosines[1:] + cosines[:-1])
    weighted = table * cosines
    between = 0.5 * (table[:, 1:] + table[:, :-1]) * middles
    mean = (
        2.0 * (weighted[:, :-1] + 4.0 * between + weighted[:, 1:]).sum(axis=1) / (6.0 * (TABLE_COSINES - 1))
    )
    return AlbedoTable(table, np.repeat(mean[:, None], 2, axis=1))


@lru_cache(maxsize=64)
def rough_dielectric_table(eta: float) -> AlbedoTable:
    """The table of the share that one bounce off or through rough glass keeps; it has no mean.

    Args:
        eta: index of refraction on the far side over that on the near side.
    """
    table = np.empty((TABLE_ROUGHNESSES, TABLE_COSINES))
    run_ranges(
        integrate_rough_dielectric, numba.get_num_threads(), len(table), eta, TABLE_SAMPLES, table, grain=1
    )
    return AlbedoTable(table, np.ones((TABLE_ROUGHNESSES, 2)))


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
    """A mixture of metal and of a matt ground under a clear coat, ``n`` points of it.

    Attributes:
        colours_linear: of the ground, and of the metal head-on.
        metallic: share of the metal.
        roughness: perceptual; GGX's alpha is its square.
        ior: index of refraction of the coat.
        ground: ``coupled`` keeps all energy; ``burley`` is Disney's diffuse term.
        multiple_scattering: light that facets of the metal throw at each other is kept.
    """

    colours_linear: Float64[np.ndarray, "n 3"]
    metallic: Float64[np.ndarray, " n"]
    roughness: Float64[np.ndarray, " n"]
    ior: float = 1.5
    ground: Literal["coupled", "burley"] = "coupled"
    multiple_scattering: bool = True

    def evaluate(
        self, to_viewer: Float64[np.ndarray, "n 3"], to_light: Float64[np.ndarray, "n 3"]
    ) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"]]:
        """Values times the cosine to the light, and the density of :meth:`sample` over solid angle."""
        values, pdf = np.empty((len(to_viewer), 3)), np.empty(len(to_viewer))
        coat = albedo_table(self.ior)
        tables = AlbedoTables(albedo_table(None).directional, coat.directional, coat.mean)
        principled_eval_array(0, len(values), to_viewer, to_light, self._arrays(), tables, values, pdf)
        return values, pdf

    def sample(
        self, to_viewer: Float64[np.ndarray, "n 3"], uniform: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Directions to the light from three numbers in [0, 1) each; some lie below the surface."""
        to_light = np.empty((len(to_viewer), 3))
        coat = albedo_table(self.ior).directional
        principled_sample_array(0, len(to_light), to_viewer, self._arrays(), coat, uniform, to_light)
        return to_light

    def _arrays(self) -> BsdfArrays:
        substrate = BURLEY if self.ground == "burley" else COUPLED
        return BsdfArrays(
            self.colours_linear, self.metallic, self.roughness, self.ior, substrate, self.multiple_scattering
        )


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
