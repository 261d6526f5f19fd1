"""The georeference by GPS in the photographs: found exactly, robust, and refused where it says nothing."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.ExifTags import GPS

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.georeference import Georeference
from octasplat.engine.dataset.photograph_gps import read_gps
from octasplat.engine.georeference.find_georeference import find_georeference
from octasplat.engine.georeference.request import read_request
from tests.support.located_scene import (
    PLACE,
    SCALE,
    apply,
    camera_centres,
    metres_about,
    open_scene,
    truth_matrix,
    write_gps,
)


def true_metres(scene: Path) -> dict[str, np.ndarray]:
    centres = camera_centres(scene)
    return dict(zip(centres, apply(truth_matrix(), np.stack(list(centres.values()))), strict=True))


def find(scene: Path, tmp_path: Path, source: str = "auto") -> tuple[Georeference | None, list[str]]:
    notes: list[str] = []
    request = read_request(scene, source, None, None)
    return find_georeference(open_scene(scene, tmp_path / "cache"), request, notes.append), notes


def test_exact_gps_gives_the_similarity(scene, tmp_path):
    write_gps(scene, true_metres(scene))
    found, (note,) = find(scene, tmp_path)
    assert found is not None and found.crs == "EPSG:4979" and found.anchor is not None
    there = metres_about(found.metres_from_scene, found.anchor)
    np.testing.assert_allclose(there, truth_matrix(), atol=1e-6 * SCALE)
    assert found.metres_per_unit == pytest.approx(SCALE, rel=1e-6)
    assert np.abs(np.subtract(found.anchor[:2], PLACE[:2])).max() < 0.01
    assert found.residuals is not None and found.residuals.rmse_m < 1e-5
    assert (found.residuals.given, found.residuals.used) == (12, 12)
    assert note.startswith("Georeference by GPS: 1 unit is 12.5 m")


def test_large_model_coordinates_are_those_of_the_user(scene, tmp_path):
    metres = true_metres(scene)
    offset = np.array((512_345.0, 5_403_210.0, 310.0))
    model = pycolmap.Reconstruction(str(scene / "sparse/0"))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), offset))
    model.write_binary(str(scene / "sparse/0"))
    write_gps(scene, metres)
    found, _ = find(scene, tmp_path)
    centres = camera_centres(scene)
    there = apply(found.metres_from_scene, np.stack([centres[name] for name in metres]))
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    about = earth.ellipsoid_to_enu(earth.enu_to_ellipsoid(there, *found.anchor), *PLACE)
    np.testing.assert_allclose(about, np.stack(list(metres.values())), atol=1e-5)


def test_wrong_positions_are_left_out_by_name(scene, tmp_path):
    metres = true_metres(scene)
    wrong = list(metres)[3]
    noise = np.random.default_rng(0).normal(0, 0.2, (len(metres), 3))
    metres = {name: position + shift for (name, position), shift in zip(metres.items(), noise, strict=True)}
    metres[wrong] = metres[wrong] + (400.0, 90.0, 30.0)
    write_gps(scene, metres)
    found, (note,) = find(scene, tmp_path)
    assert found.residuals.left_out == (wrong,) and wrong in note
    assert 0.05 < found.residuals.rmse_m < 0.6 and found.residuals.worst != wrong
    assert found.metres_per_unit == pytest.approx(SCALE, rel=0.02)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda metres, rng: {name: rng.normal(0, 40, 3) for name in metres}, "contradict"),
        (lambda metres, rng: dict(list(metres.items())[:2]), "are 2, where 3 are the least"),
        (
            lambda metres, rng: {name: np.array([10.0 * k, 0, 0]) for k, name in enumerate(metres)},
            "one line on the ground|contradict",
        ),
        (
            lambda metres, rng: {name: place + rng.normal(0, 30, 3) for name, place in metres.items()},
            "contradict|nearly on a line",
        ),
        (
            lambda metres, rng: {n: place * (k < 4) for k, (n, place) in enumerate(metres.items())},
            "lie in one place on the ground, half of them or more",
        ),
    ],
    ids=["elsewhere", "two", "line", "noise", "one fix"],
)
def test_useless_gps_is_said_or_refused(scene, tmp_path, change, reason):
    write_gps(scene, change(true_metres(scene), np.random.default_rng(1)))
    found, (note,) = find(scene, tmp_path)
    assert found is None and "not used" in note and str(scene) in note
    with pytest.raises(ConfigError, match=reason) as refused:
        find(scene, tmp_path, "gps")
    assert str(scene) in str(refused.value) and "control points" in str(refused.value)


def test_photographs_without_gps_have_no_georeference(scene, tmp_path):
    assert find(scene, tmp_path) == (None, [])
    with pytest.raises(ConfigError, match="are 0"):
        find(scene, tmp_path, "gps")


def test_off_looks_at_nothing(scene, tmp_path):
    write_gps(scene, true_metres(scene))
    assert find(scene, tmp_path, "off") == (None, [])
    with pytest.raises(ConfigError, match="off"):
        read_request(scene, "off", None, "a b 1")


def test_southern_and_western_positions_and_files_without(scene):
    name = next(iter(camera_centres(scene)))
    write_gps(scene, {name: np.array([-4.0e6, -9.0e6, 0.0])})
    latitude, longitude, _ = read_gps(scene / "images" / name)
    assert latitude < 0 and longitude < 0
    assert read_gps(scene / "sparse/0/cameras.bin") is None


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({}, (48.125, 11.5, 500.0)),
        ({GPS.GPSLatitudeRef: "s\0", GPS.GPSLongitudeRef: "W"}, (-48.125, -11.5, 500.0)),
        ({GPS.GPSLatitudeRef: ""}, None),
        ({GPS.GPSLongitudeRef: "\0"}, None),
        ({GPS.GPSLatitudeRef: (1, 2)}, None),
        ({GPS.GPSAltitudeRef: b"\1"}, (48.125, 11.5, -500.0)),
        ({GPS.GPSAltitudeRef: b"\2"}, (48.125, 11.5, 500.0)),
        ({GPS.GPSAltitudeRef: b"\3"}, (48.125, 11.5, -500.0)),
    ],
    ids=["plain", "south west", "blank", "zero", "no text", "below", "above the sea", "below the sea"],
)
def test_position_counts_only_with_its_hemisphere(tmp_path, monkeypatch, tags, expected):
    path = tmp_path / "a.jpg"
    Image.new("RGB", (8, 8)).save(path)
    degrees = {GPS.GPSLatitude: (48.0, 7.0, 30.0), GPS.GPSLongitude: (11.0, 30.0, 0.0)}
    letters = {GPS.GPSLatitudeRef: "N", GPS.GPSLongitudeRef: "E"}
    # as read, since not every damage can be written
    monkeypatch.setattr(
        Image.Exif, "get_ifd", lambda *_: {**degrees, **letters, GPS.GPSAltitude: 500.0, **tags}
    )
    assert read_gps(path) == expected
