"""Materials against closed forms: Fresnel, Snell, energy, densities and the samples that follow them."""

import numba
import numpy as np
import pytest
from scipy.stats import chi2

from octasplat.engine.pathtracing.bsdf_tables import albedo_table, rough_dielectric_table
from octasplat.engine.shading.kernels.microfacets import table_value
from tests.support.bsdf_arrays import OpaqueMaterial, RoughGlass, fresnel


@numba.njit
def value_of(table, cosine, roughness):
    return table_value(table, cosine, roughness)


def directions(cosines: np.ndarray, angles: np.ndarray) -> np.ndarray:
    across = np.sqrt(1 - cosines**2)
    return np.stack([across * np.cos(angles), across * np.sin(angles), cosines], axis=-1)


def hemisphere(rows: int, columns: int) -> tuple[np.ndarray, float]:
    """Midpoints of equal patches in (cosine, angle), and their solid angle."""
    cosines, angles = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns)
    return directions(cosines.ravel(), 2 * np.pi * angles.ravel()), 2 * np.pi / (rows * columns)


def material(
    n: int, *, metallic: float, roughness: float, color: float = 1.0, **more: object
) -> OpaqueMaterial:
    return OpaqueMaterial(
        np.full((n, 3), color),
        np.full(n, metallic),
        np.full(n, roughness),
        **more,  # type: ignore[arg-type]
    )


def towards(cosine: float, n: int) -> np.ndarray:
    return np.tile(directions(np.array([cosine]), np.array([0.3])), (n, 1))


def test_fresnel_head_on_at_brewster_and_beyond_the_critical_angle() -> None:
    brewster = np.cos(np.arctan(1.5))
    reflected, cos_t = fresnel(np.array([1.0, brewster, 1e-9]), 1.5)
    # At Brewster's angle only light across the plane of incidence is reflected.
    across = (brewster - 1.5 * cos_t[1]) / (brewster + 1.5 * cos_t[1])
    np.testing.assert_allclose(reflected, [0.04, 0.5 * across**2, 1.0], atol=1e-6)
    # From inside: all is reflected beyond asin(1 / 1.5), and Snell's law holds before.
    angles = np.radians([10.0, 30.0, 41.7, 41.9, 80.0])
    reflected, cos_t = fresnel(np.cos(angles), 1 / 1.5)
    assert (reflected[3:] == 1.0).all() and (cos_t[3:] == 0.0).all() and (reflected[:3] < 1.0).all()
    np.testing.assert_allclose(np.sqrt(1 - cos_t[:3] ** 2), 1.5 * np.sin(angles[:3]), rtol=1e-12)


def test_dielectric_index_one_reflects_nothing() -> None:
    reflected, cos_t = fresnel(np.linspace(0.01, 1.0, 50), 1.0)
    np.testing.assert_allclose(reflected, 0.0, atol=1e-20)
    np.testing.assert_allclose(cos_t, np.linspace(0.01, 1.0, 50))


@pytest.mark.parametrize("metallic", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("coat", [{}, {"clear_coat": 0.7, "clear_coat_roughness": 0.4}])
def test_bsdf_white_furnace_conserves_energy(
    metallic: float, roughness: float, coat: dict[str, float]
) -> None:
    # By the material's own samples: value over density is what each of them carries.
    n = 1 << 15
    k = np.arange(n)
    golden = np.stack([(k + 0.5) / n, (k * 0.6180339887498949) % 1, (k * 0.7548776662466927) % 1], axis=1)
    for cosine in (0.15, 0.5, 0.95):
        white, seen = material(n, metallic=metallic, roughness=roughness, **coat), towards(cosine, n)
        lit = white.sample(seen, golden)
        values, pdf = white.evaluate(seen, lit)
        kept = np.where(pdf > 0, values[:, 0] / np.maximum(pdf, 1e-30), 0.0).mean()
        assert abs(kept - 1.0) < 0.01, (cosine, kept)


@pytest.mark.parametrize("roughness", [0.35, 0.7])
@pytest.mark.parametrize("metallic", [0.0, 0.4, 1.0])
def test_bsdf_pdf_integrates_to_upper_hemisphere_share(metallic: float, roughness: float) -> None:
    lit, patch = hemisphere(1500, 700)
    n = 1 << 15
    rng = np.random.default_rng(2)
    for cosine in (0.3, 0.8):
        some = material(len(lit), metallic=metallic, roughness=roughness, color=0.5)
        total = some.evaluate(towards(cosine, len(lit)), lit)[1].sum() * patch
        few = material(n, metallic=metallic, roughness=roughness, color=0.5)
        above = (few.sample(towards(cosine, n), rng.random((n, 3)))[:, 2] > 0).mean()
        assert abs(total - above) < 4 * np.sqrt(0.25 / n) + 1e-3


@pytest.mark.parametrize(("metallic", "coat"), [(0.0, 0.0), (1.0, 0.0), (0.0, 0.8), (1.0, 1.0)])
def test_samples_follow_their_density(metallic: float, coat: float) -> None:
    n, rows, columns, fine = 200_000, 8, 16, 12
    rng = np.random.default_rng(3)
    coated = {"clear_coat": coat, "clear_coat_roughness": 0.5}
    some = material(n, metallic=metallic, roughness=0.6, color=0.5, **coated)
    lit = some.sample(towards(0.7, n), rng.random((n, 3)))
    lit = lit[lit[:, 2] > 0]
    angle = np.arctan2(lit[:, 1], lit[:, 0]) / (2 * np.pi) % 1
    counted = np.histogram2d(lit[:, 2], angle, bins=(rows, columns), range=((0, 1), (0, 1)))[0]
    cosines, angles = np.meshgrid(
        (np.arange(rows * fine) + 0.5) / (rows * fine), (np.arange(columns * fine) + 0.5) / (columns * fine),
        indexing="ij",
    )  # fmt: skip
    grid = directions(cosines.ravel(), 2 * np.pi * angles.ravel())
    pdf = material(len(grid), metallic=metallic, roughness=0.6, color=0.5, **coated).evaluate(
        towards(0.7, len(grid)), grid
    )[1]
    patch = 2 * np.pi / len(grid)
    expected = n * patch * pdf.reshape(rows, fine, columns, fine).sum(axis=(1, 3))
    used = expected > 10
    statistic = ((counted - expected) ** 2 / np.maximum(expected, 1e-9))[used].sum()
    assert statistic < chi2.ppf(0.9999, used.sum())


def test_clear_coat_sends_back_its_albedo_and_leaves_the_rest_to_what_is_below() -> None:
    n = 1 << 15

    def albedo(cosine: float, **more: float) -> float:
        some = material(n, metallic=0.3, roughness=0.5, color=0.4, **more)
        lit = some.sample(towards(cosine, n), golden(n))
        values, pdf = some.evaluate(towards(cosine, n), lit)
        return float(np.where(pdf > 0, values[:, 0] / np.maximum(pdf, 1e-30), 0.0).mean())

    for cosine in (0.2, 0.6, 0.95):
        for coat, roughness in ((1.0, 0.1), (0.5, 0.6)):
            reflected = coat * value_of(albedo_table(1.5).directional, cosine, roughness)
            expected = reflected + (1 - reflected) * albedo(cosine)
            found = albedo(cosine, clear_coat=coat, clear_coat_roughness=roughness)
            assert found == pytest.approx(expected, rel=0.01)
    # head-on a smooth coat reflects 4 %
    assert value_of(albedo_table(1.5).directional, 1.0, 0.0) == pytest.approx(0.04, abs=1e-3)


def test_values_do_not_change_when_light_and_viewer_are_swapped() -> None:
    rng = np.random.default_rng(4)
    a = directions(rng.uniform(0.1, 1, 500), rng.uniform(0, 7, 500))
    b = directions(rng.uniform(0.1, 1, 500), rng.uniform(0, 7, 500))
    some = OpaqueMaterial(
        rng.random((500, 3)), rng.random(500), rng.uniform(0.2, 1, 500), multiple_scattering=False
    )
    there = some.evaluate(a, b)[0] / b[:, 2:]
    back = some.evaluate(b, a)[0] / a[:, 2:]
    np.testing.assert_allclose(there, back, rtol=1e-9)


def test_smooth_coat_reflectance_is_fresnel() -> None:
    table = albedo_table(1.5).directional[0]
    cosines = np.linspace(0, 1, len(table))[2:]
    np.testing.assert_allclose(table[2:], fresnel(cosines, 1.5)[0], atol=2e-3)


def golden(n: int) -> np.ndarray:
    k = np.arange(n)
    return np.stack([(k + 0.5) / n, (k * 0.6180339887498949) % 1, (k * 0.7548776662466927) % 1], axis=1)


@pytest.mark.parametrize("eta", [1.5, 1 / 1.5])
@pytest.mark.parametrize("roughness", [0.2, 0.6, 1.0])
def test_rough_dielectric_energy_matches_table(eta: float, roughness: float) -> None:
    n = 1 << 14
    for cosine in (0.15, 0.5, 0.95):
        glass, seen = RoughGlass(eta, roughness), towards(cosine, n)
        values, pdf = glass.evaluate(seen, glass.sample(seen, golden(n)))
        kept = np.where(pdf > 0, values / np.maximum(pdf, 1e-30), 0.0).mean()
        assert abs(kept / value_of(rough_dielectric_table(eta).directional, cosine, roughness) - 1) < 0.015


@pytest.mark.parametrize("eta", [1.5, 1 / 1.5])
def test_samples_of_rough_glass_follow_their_density_on_both_sides(eta: float) -> None:
    n, rows, columns, fine = 100_000, 16, 12, 40
    rng = np.random.default_rng(5)
    glass = RoughGlass(eta, 0.7)
    lit = glass.sample(towards(0.7, n), rng.random((n, 3)))
    pdf = glass.evaluate(towards(0.7, n), lit)[1]
    lit = lit[pdf > 0]
    angle = np.arctan2(lit[:, 1], lit[:, 0]) / (2 * np.pi) % 1
    counted = np.histogram2d(lit[:, 2], angle, bins=(rows, columns), range=((-1, 1), (0, 1)))[0]
    cosines, angles = np.meshgrid(
        (np.arange(rows * fine) + 0.5) / (rows * fine) * 2 - 1,
        (np.arange(columns * fine) + 0.5) / (columns * fine), indexing="ij",
    )  # fmt: skip
    grid = directions(cosines.ravel(), 2 * np.pi * angles.ravel())
    pdf = glass.evaluate(towards(0.7, len(grid)), grid)[1]
    expected = n * 4 * np.pi / len(grid) * pdf.reshape(rows, fine, columns, fine).sum(axis=(1, 3))
    used = expected > 10
    statistic = ((counted - expected) ** 2 / np.maximum(expected, 1e-9))[used].sum()
    assert statistic < chi2.ppf(0.9999, used.sum())


def test_rough_glass_is_the_same_from_both_sides() -> None:
    # Of basic radiance the value without the cosine is symmetric, once the sides are swapped.
    rng = np.random.default_rng(6)
    a = directions(rng.uniform(0.2, 1, 500), rng.uniform(0, 7, 500))
    b = directions(-rng.uniform(0.2, 1, 500), rng.uniform(0, 7, 500))
    there = RoughGlass(1.5, 0.6).evaluate(a, b)[0] / -b[:, 2]
    flip = np.array([1, 1, -1])
    back = RoughGlass(1 / 1.5, 0.6).evaluate(b * flip, a * flip)[0] / a[:, 2]
    assert (there > 0).mean() > 0.2
    # What is carried in is larger by the square of the index than what is carried out.
    np.testing.assert_allclose(there, back * 1.5**2, rtol=1e-9)
