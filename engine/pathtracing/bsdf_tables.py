"""Tables of directional albedos, by which the BSDFs keep the energy of light that scatters several times."""

from dataclasses import dataclass
from functools import lru_cache

import numba
import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.pathtracing.kernels.albedo_integrals import integrate_albedo, integrate_rough_dielectric

TABLE_ROUGHNESSES = 32
TABLE_COSINES = 64
TABLE_SAMPLES = 512


@dataclass(frozen=True)
class AlbedoTable:
    """Directional albedo of a single bounce off GGX microfacets.

    Attributes:
        directional: rows are roughness 0 to 1, columns the cosine of the direction 0 to 1.
        mean: cosine-weighted mean over all directions, a row a roughness; its two columns are the same.
    """

    directional: Float64[np.ndarray, "a c"]
    mean: Float64[np.ndarray, "a 2"]


@lru_cache(maxsize=64)
def albedo_table(ior: float | None) -> AlbedoTable:
    """Return the albedo table of a dielectric's surface, or of perfect reflectors if ``ior`` is None."""
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
    # two equal columns, so that what interpolates over cosines can read it too
    return AlbedoTable(table, np.repeat(mean[:, None], 2, axis=1))


@lru_cache(maxsize=64)
def rough_dielectric_table(eta: float) -> AlbedoTable:
    """Return the albedo table of a rough dielectric, reflection and transmission; it has no mean.

    Args:
        eta: index of refraction on the far side over that on the near side.
    """
    table = np.empty((TABLE_ROUGHNESSES, TABLE_COSINES))
    run_ranges(
        integrate_rough_dielectric, numba.get_num_threads(), len(table), eta, TABLE_SAMPLES, table, grain=1
    )
    return AlbedoTable(table, np.ones((TABLE_ROUGHNESSES, 2)))
