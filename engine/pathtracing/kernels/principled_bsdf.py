"""Materials as compiled functions of directions: their values, their samples and the densities of these.

Directions are in the frame of the shading normal (z), ``o`` towards the viewer and ``i`` towards the light,
both of unit length. Values are linear and already hold the cosine to the light. Everything is a pure
function of its arguments.

Microfacets are those of :mod:`octasplat.engine.shading.kernels.microfacets`. Light that facets throw at each
other: "Practical multiple scattering compensation for microfacet models" (Turquin 2019). The ground under a
coat takes what the coat leaves, in both directions: "A Microfacet Based Coupled Specular-Matte BRDF Model"
(Kelemen and Szirmay-Kalos 2001). A clear coat lies over all of it, as in glTF's KHR_materials_clearcoat: what
is under it keeps what the coat's directional albedo leaves, so that no light is lost or won.
"""

import math

import numpy as np
from jaxtyping import Float64

from octasplat.engine.pathtracing.kernels.kernel_args import AlbedoTables, Bsdf, Vec3
from octasplat.engine.shading.kernels.microfacets import (
    ggx_density,
    ggx_masking,
    sample_visible_normal,
    schlick_weight,
    table_value,
)
from octasplat.engine.trace.kernels.native import njit_no_refcount

MIN_ALPHA = 1e-3
COUPLED, BURLEY = 0, 1
CLEAR_COAT_IOR = 1.5


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def fresnel_dielectric(cos_o: float, eta: float) -> tuple[float, float]:
    """Return share of unpolarised light that a smooth surface reflects, and the cosine of the refracted ray.

    ``eta`` is the index of refraction on the other side over that on the side of ``cos_o`` >= 0. Where all
    is reflected the share is 1 and the cosine 0.
    """
    sin2_t = (1.0 - cos_o * cos_o) / (eta * eta)
    if sin2_t >= 1.0:
        return 1.0, 0.0
    cos_t = math.sqrt(1.0 - sin2_t)
    parallel = (eta * cos_o - cos_t) / (eta * cos_o + cos_t)
    across = (cos_o - eta * cos_t) / (cos_o + eta * cos_t)
    return 0.5 * (parallel * parallel + across * across), cos_t


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def cos_sin_of_turns(v: float) -> tuple[float, float]:
    """Return cosine and sine of 2 pi v, for v from 0 to 1, to 1e-10.

    Taylor's series about the nearest quarter of a turn: no call and no branch, so that several go on at once.
    """
    quarter = int(4.0 * v + 0.5)
    x = 2.0 * math.pi * (v - 0.25 * quarter)
    x2 = x * x
    sine = 1 / 362880 - x2 * (1 / 39916800)
    sine = x * (1.0 + x2 * (-1 / 6 + x2 * (1 / 120 + x2 * (-1 / 5040 + x2 * sine))))
    cosine = -1 / 3628800 + x2 * (1 / 479001600)
    cosine = 1.0 + x2 * (-1 / 2 + x2 * (1 / 24 + x2 * (-1 / 720 + x2 * (1 / 40320 + x2 * cosine))))
    # odd quarters swap both
    a, b = (sine, cosine) if quarter & 1 else (cosine, sine)
    return (-a if (quarter + 1) & 2 else a), (-b if quarter & 2 else b)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def sample_cosine(u: float, v: float) -> tuple[float, float, float]:
    """Return a direction over the hemisphere, as dense as its cosine; its density is cosine / pi."""
    radius = math.sqrt(u)
    cosine, sine = cos_sin_of_turns(v)
    return radius * cosine, radius * sine, math.sqrt(max(1.0 - u, 0.0))


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def specular_probability(o_z: float, bsdf: Bsdf, coat_albedo: Float64[np.ndarray, "a c"]) -> float:
    """Return the probability with which a sample goes to the specular lobe rather than to the ground."""
    (red, green, blue), metallic, roughness = bsdf.rgb, bsdf.metallic, bsdf.roughness
    if metallic >= 1.0:
        return 1.0
    sheen = table_value(coat_albedo, o_z, roughness)
    ground = (1.0 - metallic) * (1.0 - sheen) * (red + green + blue) / 3.0
    specular = (1.0 - metallic) * sheen + metallic * (red + green + blue) / 3.0
    if ground <= 0.0:
        return 1.0
    return min(max(specular / (specular + ground), 0.1), 0.9)  # neither lobe is left without samples


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _base_eval(o: Vec3, i: Vec3, bsdf: Bsdf, tables: AlbedoTables) -> tuple[float, float, float, float]:
    """Return value times cosine (three channels) and density of the mixture of dielectric and metal."""
    o_x, o_y, o_z = o
    i_x, i_y, i_z = i
    (red, green, blue), metallic, roughness = bsdf.rgb, bsdf.metallic, bsdf.roughness
    if o_z <= 0.0 or i_z <= 0.0:
        return 0.0, 0.0, 0.0, 0.0
    alpha = max(roughness * roughness, MIN_ALPHA)
    h_x, h_y, h_z = o_x + i_x, o_y + i_y, o_z + i_z
    inverse = 1.0 / math.sqrt(h_x * h_x + h_y * h_y + h_z * h_z)
    h_x, h_y, h_z = inverse * h_x, inverse * h_y, inverse * h_z
    cos_d = o_x * h_x + o_y * h_y + o_z * h_z
    masking_o, masking_i = ggx_masking(o_z, alpha), ggx_masking(i_z, alpha)
    density = ggx_density(h_z, alpha) / (4.0 * o_z)  # with the cosine to the light divided out
    specular = density * masking_o * masking_i
    fresnel, _ = fresnel_dielectric(cos_d, bsdf.ior)
    weight = schlick_weight(cos_d)
    loss = 0.0
    # Turquin: what one bounce loses, 1/E - 1, comes back tinted by the metal
    if bsdf.energy_compensation and metallic > 0.0:
        loss = 1.0 / table_value(tables.ggx_albedo, o_z, roughness) - 1.0
    plain = (1.0 - metallic) * fresnel
    f_r = specular * (plain + metallic * (red + (1.0 - red) * weight) * (1.0 + red * loss))
    f_g = specular * (plain + metallic * (green + (1.0 - green) * weight) * (1.0 + green * loss))
    f_b = specular * (plain + metallic * (blue + (1.0 - blue) * weight) * (1.0 + blue * loss))
    share = specular_probability(o_z, bsdf, tables.coat_albedo)
    if metallic < 1.0:
        ground = (1.0 - metallic) * i_z / math.pi
        if bsdf.substrate == BURLEY:
            at_o, at_i = schlick_weight(o_z), schlick_weight(i_z)
            retro = 2.0 * roughness * cos_d * cos_d  # R_R of Burley's retro-reflection (2015)
            ground *= (1.0 - 0.5 * at_o) * (1.0 - 0.5 * at_i) + retro * (
                at_o + at_i + at_o * at_i * (retro - 1.0)
            )
        else:
            # Kelemen: normalized by what the coat leaves on average
            left = 1.0 - table_value(tables.coat_mean_albedo, 0.0, roughness)
            ground *= (
                (1.0 - table_value(tables.coat_albedo, o_z, roughness))
                * (1.0 - table_value(tables.coat_albedo, i_z, roughness))
                / left
            )
        f_r += ground * red
        f_g += ground * green
        f_b += ground * blue
    # G1(o) D / (4 o_z), the density of visible normals
    pdf = share * density * masking_o + (1.0 - share) * i_z / math.pi
    return f_r, f_g, f_b, pdf


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _base_sample(
    o: Vec3, bsdf: Bsdf, coat_albedo: Float64[np.ndarray, "a c"], choice: float, u: float, v: float
) -> Vec3:
    """Draw a direction to the light, as dense as :func:`_base_eval` says; worth 0 below the surface."""
    share = specular_probability(o[2], bsdf, coat_albedo)
    if choice >= share:
        return sample_cosine(u, v)
    return _sample_reflection(o, max(bsdf.roughness * bsdf.roughness, MIN_ALPHA), u, v)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _sample_reflection(o: Vec3, alpha: float, u: float, v: float) -> Vec3:
    """Return o reflected at a visible facet."""
    o_x, o_y, o_z = o
    h_x, h_y, h_z = sample_visible_normal(o_x, o_y, o_z, alpha, u, v)
    twice = 2.0 * (o_x * h_x + o_y * h_y + o_z * h_z)
    return twice * h_x - o_x, twice * h_y - o_y, twice * h_z - o_z


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _clear_coat_shares(o_z: float, bsdf: Bsdf, tables: AlbedoTables) -> tuple[float, float]:
    """Return the share of light that the clear coat reflects, and the probability of a sample of it."""
    reflected = bsdf.clear_coat * table_value(tables.clear_coat_albedo, o_z, bsdf.clear_coat_roughness)
    red, green, blue = bsdf.rgb
    below = (1.0 - reflected) * max((red + green + blue) / 3.0, 0.04)
    return reflected, min(max(reflected / (reflected + below), 0.1), 0.9)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def principled_eval(o: Vec3, i: Vec3, bsdf: Bsdf, tables: AlbedoTables) -> tuple[float, float, float, float]:
    """Return value times cosine (three channels) and density of the material with its clear coat."""
    f_r, f_g, f_b, pdf = _base_eval(o, i, bsdf, tables)
    o_x, o_y, o_z = o
    i_x, i_y, i_z = i
    if bsdf.clear_coat <= 0.0 or o_z <= 0.0 or i_z <= 0.0:
        return f_r, f_g, f_b, pdf
    alpha = max(bsdf.clear_coat_roughness * bsdf.clear_coat_roughness, MIN_ALPHA)
    h_x, h_y, h_z = o_x + i_x, o_y + i_y, o_z + i_z
    length = math.sqrt(h_x * h_x + h_y * h_y + h_z * h_z)
    fresnel, _ = fresnel_dielectric((o_x * h_x + o_y * h_y + o_z * h_z) / length, CLEAR_COAT_IOR)
    # D G1(o) / (4 o_z): the density of the coat's samples
    density = ggx_density(h_z / length, alpha) * ggx_masking(o_z, alpha) / (4.0 * o_z)
    coat = bsdf.clear_coat * fresnel * density * ggx_masking(i_z, alpha)
    reflected, share = _clear_coat_shares(o_z, bsdf, tables)
    left = 1.0 - reflected
    return (
        left * f_r + coat, left * f_g + coat, left * f_b + coat, share * density + (1.0 - share) * pdf
    )  # fmt: skip


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def principled_sample(o: Vec3, bsdf: Bsdf, tables: AlbedoTables, choice: float, u: float, v: float) -> Vec3:
    """Draw a direction to the light, as dense as :func:`principled_eval` says; worth 0 below the surface."""
    if bsdf.clear_coat > 0.0:
        _, share = _clear_coat_shares(o[2], bsdf, tables)
        if choice < share:
            alpha = max(bsdf.clear_coat_roughness * bsdf.clear_coat_roughness, MIN_ALPHA)
            return _sample_reflection(o, alpha, u, v)
        choice = (choice - share) / (1.0 - share)
    return _base_sample(o, bsdf, tables.coat_albedo, choice, u, v)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def orthonormal_basis(n_x: float, n_y: float, n_z: float) -> tuple[float, float, float, float, float, float]:
    """Return two unit vectors that complete the unit vector n to a right-handed frame.

    "Building an Orthonormal Basis, Revisited" (Duff et al. 2017, https://jcgt.org/published/0006/01/01/).
    """
    sign = 1.0 if n_z >= 0.0 else -1.0
    a = -1.0 / (sign + n_z)
    b = n_x * n_y * a
    return 1.0 + sign * n_x * n_x * a, sign * b, -sign * n_x, b, sign + n_y * n_y * a, -n_y
