"""Places on the Earth against positions that PROJ 9.5 gives for them."""

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.earth_frame import geocentric, geocentric_from_metres
from octasplat.engine.core.georeference import Georeference, matrix_rows

MILLIMETRE = 1e-3


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.0, 0.0, 0.0), (6_378_137.0, 0.0, 0.0)),
        ((-90.0, 12.0, 0.0), (0.0, 0.0, -6_356_752.314245)),
        ((48.137222, 11.575556, 520.0), (4177973.506525, 855757.411379, 4727459.565375)),
        ((-33.8568, 151.2153, 12.5), (-4646977.735117, 2553081.918549, -3533274.091479)),
        ((78.2232, 15.6267, -3.0), (1257698.642061, 351787.632934, 6222067.108774)),
        ((0.0, -78.455833, 2850.0), (1276983.916915, -6251904.283505, 0.0)),
    ],
)
def test_latitude_longitude_and_height_become_geocentric(place, expected):
    np.testing.assert_allclose(geocentric(*place), expected, atol=MILLIMETRE)


def at(crs: str, anchor: tuple[float, float, float]) -> np.ndarray:
    frame = geocentric_from_metres(Georeference(crs=crs, anchor=anchor, matrix=matrix_rows(np.eye(4))))
    assert frame is not None
    return frame


def test_metres_are_east_north_and_up_of_the_anchor():
    anchor = (48.137222, 11.575556, 520.0)
    frame = at("EPSG:4979", anchor)
    np.testing.assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-12)
    metres = np.array([[10.0, 20.0, 30.0], [-500.0, 300.0, 7.0], [0.0, 0.0, -1.0]])
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    expected = earth.ellipsoid_to_ecef(earth.enu_to_ellipsoid(metres, *anchor))
    np.testing.assert_allclose(metres @ frame[:3, :3].T + frame[:3, 3], expected, atol=MILLIMETRE)


@pytest.mark.parametrize(
    ("crs", "anchor", "here", "away"),
    [
        (
            "EPSG:32632",
            (691600.0, 5334760.0, 520.0),
            (4177975.176629, 855749.720761, 4727459.482090),
            (4177883.970288, 855836.479101, 4727523.946035),
        ),
        (
            "EPSG:32756",
            (334900.0, 6252300.0, 12.5),
            (-4646983.050929, 2553085.266254, -3533264.744086),
            (-4647080.009589, 2553022.466628, -3533183.148309),
        ),
        (
            "EPSG:32633",
            (513000.0, 8683000.0, 30.0),
            (1258373.018246, 350644.054535, 6222029.498644),
            (1258252.489025, 350715.327927, 6222049.720527),
        ),
        (
            "EPSG:25832",
            (291600.0, 5634760.0, 100.0),
            (4014616.152745, 424842.208734, 4921487.421123),
            (4014525.949543, 424929.102748, 4921553.057370),
        ),
        (
            "EPSG:26910",
            (551000.0, 4181000.0, 15.0),
            (-2706290.988906, -4260998.370907, 3885736.203866),
            (-2706173.372859, -4261000.928056, 3885814.783411),
        ),
    ],
)
def test_metres_of_utm_follow_its_grid(crs, anchor, here, away):
    """100 m east and north the Earth curves by 1.6 mm away from the level plane at the anchor."""
    frame = at(crs, anchor)
    np.testing.assert_allclose(frame[:3, 3], here, atol=MILLIMETRE)
    moved = frame @ (100.0, 100.0, 0.0, 1.0)
    up = np.array(here) / np.linalg.norm(here)
    apart = moved[:3] - away
    assert np.linalg.norm(apart - (apart @ up) * up) < MILLIMETRE
    assert np.linalg.norm(apart) < 2.0 * MILLIMETRE


@pytest.mark.parametrize("crs", ["EPSG:2056", "EPSG:32661", "EPSG:25850", "EPSG:32600", "EPSG:26924"])
def test_other_systems_are_not_known(crs):
    given = Georeference(crs=crs, anchor=(2600000.0, 1200000.0, 500.0), matrix=matrix_rows(np.eye(4)))
    assert geocentric_from_metres(given) is None
    assert geocentric_from_metres(Georeference(matrix=matrix_rows(np.eye(4)))) is None
