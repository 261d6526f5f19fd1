"""The georeference by ground control points and known lengths, and files that say nonsense."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.georeference import Georeference
from octasplat.engine.dataset import load_dataset_model
from octasplat.engine.georeference.control_file import read_control_file
from octasplat.engine.georeference.find_georeference import find_georeference
from octasplat.engine.georeference.request import read_request
from tests.support.located_scene import (
    PLACE,
    SCALE,
    apply,
    camera_centres,
    open_scene,
    project,
    truth_matrix,
    write_gps,
)

UTM = np.array((691_600.0, 5_334_760.0, 520.0))
POINTS = np.array([[0.3, 0.1, 0.2], [-0.4, 0.0, 0.3], [0.1, -0.2, -0.4], [-0.2, 0.1, -0.3], [0.4, -0.1, 0.0]])


def sightings(scene: Path, point: np.ndarray) -> list[tuple[str, float, float]]:
    """Return where photographs show a point."""
    found = []
    for view in load_dataset_model(scene).views:
        x, y = project(scene, view.name, point)
        seen = view.rotation_cam_from_world @ point + view.translation_cam_from_world
        if seen[2] > 0 and 0 <= x <= view.width_px and 0 <= y <= view.height_px:
            found.append((view.name, float(x), float(y)))
    assert len(found) > 3
    return found[:4]


def gcp_list(scene: Path, ground: np.ndarray, head: str) -> str:
    rows = [
        f"{place[0]!r} {place[1]!r} {place[2]!r} {x!r} {y!r} {name} gcp{k}"
        for k, (point, place) in enumerate(zip(POINTS, ground.tolist(), strict=True))
        for name, x, y in sightings(scene, point)
    ]
    return "\n".join([head, *rows])


def csv_text(scene: Path, ground: np.ndarray | None, head: str) -> str:
    rows = [head, "name,x,y,z,photograph,px,py"]
    for k, point in enumerate(POINTS):
        place = ",," if ground is None else ",".join(map(repr, ground[k].tolist()))
        rows += [f"gcp{k},{place},{name},{x!r},{y!r}" for name, x, y in sightings(scene, point)]
    return "\n".join(rows)


def find(
    scene: Path,
    tmp_path: Path,
    file: str | None = None,
    length: str | None = None,
    source: str = "auto",
    note: Callable[[str], None] = lambda _text: None,
) -> Georeference | None:
    request = read_request(scene, source, file, length)
    return find_georeference(open_scene(scene, tmp_path / "cache"), request, note)


@pytest.mark.parametrize("code", ["EPSG:4549", "EPSG:4647", "EPSG:4471", "EPSG:4484"])
def test_projected_systems_among_the_numbers_of_degrees_are_read(tmp_path: Path, code: str) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"{code}\n32691632.1 5334761.4 520.3 10 10 a.jpg a\n", encoding="utf-8")
    assert read_control_file(path).crs == code


@pytest.mark.parametrize(
    ("comments", "crs"),
    [
        ("# by a receiver for WGS84\n# EPSG:32632", "EPSG:32632"),
        ("# WGS84 UTM 32N", "EPSG:32632"),
        ("# +proj=utm +zone=32 +south", "EPSG:32732"),
        ("# WGS84", "EPSG:4979"),
        ("# local metres", None),
        ("# by tape, not WGS84\n# local", None),
        ("# WGS 84 / UTM zone 32N", "EPSG:32632"),
        ("# EPSG: 32632", "EPSG:32632"),
        ("# urn:ogc:def:crs:EPSG::32632", "EPSG:32632"),
        ("# EPSG:32632+5773", "EPSG:32632"),
        ("# +zone=10 +proj=utm +datum=NAD83 +units=m +no_defs", "EPSG:26910"),
    ],
)
def test_comments_of_a_csv_say_the_system(tmp_path: Path, comments: str, crs: str | None) -> None:
    path = tmp_path / "control_points.csv"
    path.write_text(f"{comments}\nname,x,y,z\na.jpg,11.5,48.1,520\n", encoding="utf-8")
    assert read_control_file(path).crs == crs


@pytest.mark.parametrize("system", ["UTM zone 32", "ETRS89, zone 32", "ESRI:102039", "EPSG:3857123"])
def test_unknown_system_in_a_comment_is_refused(tmp_path: Path, system: str) -> None:
    path = tmp_path / "control_points.csv"
    path.write_text(f"# {system}\nname,x,y,z\na.jpg,691632.1,5334761.4,520\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=f"'{system}' is not known"):
        read_control_file(path)


@pytest.mark.parametrize(
    "system",
    [
        "+proj=utm +zone=10 +datum=WGS84 +units=us-ft +no_defs",
        "+proj=utm +zone=10 +datum=NAD27 +units=m",
        "+proj=utm +zone=32 +ellps=intl +towgs84=-87,-98,-121 +units=m",
        "+proj=longlat +datum=NAD27",
        "+proj=utm +zone=32 +units=km",
    ],
)
def test_other_units_and_ellipsoids_of_a_proj_string_are_refused(tmp_path: Path, system: str) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"{system}\n691632.1 5334761.4 520.3 10 10 a.jpg a\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="is not known"):
        read_control_file(path)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("26741", "in feet or another unit"),  # NAD27 / California zone I
        ("6418", "in feet or another unit"),  # NAD83(2011) / California zone 1
        ("32056", "in feet or another unit"),  # NAD27 / Wyoming
        ("6318", "gives no metres"),  # NAD83(2011), degrees
        ("7844", "gives no metres"),  # GDA2020, degrees
        ("5773", "gives no metres"),  # heights alone
        ("2048", "counts to the west"),  # Hartebeesthoek94 / Lo19
        ("5513", "counts to the west"),  # S-JTSK / Krovak
        ("4087", "a map of the whole Earth"),
        ("2263", "in feet or another unit"),  # NAD83 / New York Long Island
        ("99999", "is no coordinate system"),
        ("32632+6360", "heights of NAVD88"),  # NAVD88 in feet
    ],
)
def test_numbers_that_give_no_metres_are_refused(tmp_path: Path, code: str, message: str) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(f"EPSG:{code}\n1 2 3 10 10 a.jpg a\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        read_control_file(path)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize(
    ("delimiter", "first"),
    [
        (",", "A,691632.1,5334761.4,520.3,a.jpg,1.5,2"),
        (",", '"A","691632.1","5334761.4","520.3","a.jpg","1.5","2"'),
        (";", "A;691632,1;5334761,4;520,3;a.jpg;1,5;2"),
        (";", "A;691632.1;5334761.4;520.3;a.jpg;1.5;2"),
        ("\t", "A\t691632.1\t5334761.4\t520.3\ta.jpg\t1.5\t2"),
    ],
    ids=["comma", "quoted", "decimal comma", "semicolon", "tab"],
)
def test_tables_as_spreadsheets_save_them_are_read(
    tmp_path: Path, delimiter: str, first: str, newline: str
) -> None:
    names = ["name", "x", "y", "z", "photograph", "px", "py"]
    head = delimiter.join(f'"{name}"' if first.startswith('"') else name for name in names)
    second = delimiter.join(["A", "", "", "", "b.jpg", "3", "4"])  # the position is not repeated
    path = tmp_path / "points.csv"
    text = "\n".join(["# EPSG:32632", head, first, second, ""])
    path.write_text(text, encoding="utf-8-sig", newline=newline)
    found = read_control_file(path)
    (point,) = found.points
    assert found.crs == "EPSG:32632"
    assert point.name == "A" and point.position == (691632.1, 5334761.4, 520.3)
    assert [(mark.photograph, mark.x_px, mark.y_px) for mark in point.marks] == [
        ("a.jpg", 1.5, 2.0),
        ("b.jpg", 3.0, 4.0),
    ]


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("name,easting,northing,height", "no column x and no y and no z, but easting, northing, height"),
        ("name,latitude,longitude,altitude", "but latitude, longitude, altitude"),
        ("name,x,y,elevation", "no column z, but elevation"),
        ("label,name,x,y,z", "two columns name"),
    ],
)
def test_positions_under_other_names_are_refused_rather_than_left_out(
    tmp_path: Path, head: str, message: str
) -> None:
    path = tmp_path / "points.csv"
    path.write_text(f"# EPSG:32632\n{head}\na,1,2,3\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        read_control_file(path)


@pytest.mark.parametrize("head", ["EPSG:32632", "WGS84 UTM 32N", "+proj=utm +zone=32 +datum=WGS84"])
def test_gcp_list_gives_the_similarity(scene, tmp_path, head):
    ground = apply(truth_matrix(), POINTS) + UTM
    (scene / "gcp_list.txt").write_text(gcp_list(scene, ground, head))
    found = find(scene, tmp_path)
    assert found.crs == "EPSG:32632" and found.method == "control points"
    there = found.metres_from_scene
    there[:3, 3] += np.subtract(found.anchor, UTM)
    np.testing.assert_allclose(there, truth_matrix(), atol=1e-6 * SCALE)
    assert found.residuals.used == 5 and found.residuals.rmse_m < 1e-6


def test_points_called_as_photographs_take_none_from_marks(scene, tmp_path):
    views = load_dataset_model(scene).views
    text = gcp_list(scene, apply(truth_matrix(), POINTS), "local")
    for k, view in enumerate(views[: len(POINTS)]):
        text = text.replace(f"gcp{k}", Path(view.name).stem)
    # spelt otherwise than the files are, which the points must not make ambiguous
    (scene / "gcp_list.txt").write_text(text.replace(Path(views[0].name).suffix, ".tif"))
    found = find(scene, tmp_path)
    assert found.residuals.given == found.residuals.used == 5 and found.residuals.rmse_m < 1e-6


def test_csv_gives_the_similarity_whatever_the_photographs_size(scene, tmp_path):
    ground = apply(truth_matrix(), POINTS)
    (scene / "targets.csv").write_text(csv_text(scene, ground, "# local metres"))
    found = find(scene, tmp_path, "targets.csv")
    assert found.crs is None and found.anchor is None
    np.testing.assert_allclose(found.metres_from_scene, truth_matrix(), atol=1e-6 * SCALE)


def test_degrees_and_cameras_by_name(scene, tmp_path):
    import pycolmap

    centres = camera_centres(scene)
    metres = apply(truth_matrix(), np.stack(list(centres.values())))
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    degrees = earth.enu_to_ellipsoid(metres, *PLACE)
    rows = [f"{n},{x!r},{y!r},{z!r}" for n, (y, x, z) in zip(centres, degrees.tolist(), strict=True)]
    (scene / "control_points.csv").write_text("\n".join(["# EPSG:4326", "name,x,y,z", *rows]))
    found = find(scene, tmp_path)
    assert found.crs == "EPSG:4979" and found.metres_per_unit == pytest.approx(SCALE, rel=1e-6)
    assert found.residuals.rmse_m < 1e-4


def test_photographs_without_a_pose_are_not_taken_for_others_of_their_name(scene, tmp_path):
    centres = camera_centres(scene)
    unposed, wrong = scene / "images" / "later", 1000.0
    unposed.mkdir()
    for name in centres:
        shutil.copy(scene / "images" / name, unposed / name)
    ground = apply(truth_matrix(), np.stack(list(centres.values()))).tolist()
    rows = [f"{name},{x!r},{y!r},{z!r}" for name, (x, y, z) in zip(centres, ground, strict=True)][:4]
    rows += [f"later/{name},{wrong},{wrong},{wrong}" for name in list(centres)[4:7]]
    # marks of one point of the scene in photographs of which one has no pose
    (first, *_), (second, x, y), *_ = sightings(scene, POINTS[0])
    rows += [f"gcp,{wrong},0,0,later/{first},10,10", f"gcp,{wrong},0,0,{second},{x},{y}"]
    (scene / "targets.csv").write_text("\n".join(["name,x,y,z,photograph,px,py", *rows]))
    notes: list[str] = []
    found = find(scene, tmp_path, "targets.csv", note=notes.append)
    assert found.residuals.given == found.residuals.used == 4 and found.residuals.rmse_m < 1e-6
    assert f"later/{list(centres)[4]} is left out, as it has no pose." in notes[0]
    assert "gcp is left out, as fewer than two of its photographs have poses." in notes[3]
    with pytest.raises(ConfigError, match=f"known_length: later/{first} is no"):
        find(scene, tmp_path, None, f"later/{first} {second} 2")


def test_switched_control_point_and_a_second_file_are_left_out_with_a_word(scene, tmp_path):
    ground = apply(truth_matrix(), POINTS)
    ground[4] += (6.0, 0.0, 0.0)
    (scene / "gcp_list.txt").write_text(gcp_list(scene, ground, "EPSG:32632"))
    (scene / "control_points.csv").write_text("name,x,y,z")
    notes: list[str] = []
    found = find(scene, tmp_path, note=notes.append)
    assert found.residuals.left_out == ("gcp4",)
    assert notes[0].startswith(f"{scene / 'control_points.csv'} is not read") and len(notes) == 2
    assert found.metres_per_unit == pytest.approx(SCALE, rel=1e-6)


def test_known_length_scales_and_cameras_say_what_is_up(scene, tmp_path):
    (scene / "marks.csv").write_text(csv_text(scene, None, ""))
    length = float(np.linalg.norm(POINTS[0] - POINTS[1]) * 3)
    found = find(scene, tmp_path, "marks.csv", f"gcp0 gcp1 {length!r}")
    assert found.crs is None and found.metres_per_unit == pytest.approx(3, rel=1e-6)
    matrix = found.metres_from_scene
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, 9 * np.eye(3), atol=1e-5)
    assert (matrix[:3, :3] @ (0, 0, 1))[2] > 2.9  # the generated scene has z up
    cameras = list(camera_centres(scene).items())
    units = float(np.linalg.norm(cameras[0][1] - cameras[5][1]))
    by_cameras = find(scene, tmp_path, None, f"{cameras[0][0]} {cameras[5][0]} {2 * units!r}")
    assert by_cameras.metres_per_unit == pytest.approx(2, rel=1e-9)
    assert find(scene, tmp_path, None, "0,0,0 0,0,2 1").metres_per_unit == pytest.approx(0.5)


def test_known_length_corrects_the_scale_of_gps(scene, tmp_path):
    centres = camera_centres(scene)
    metres = apply(truth_matrix(), np.stack(list(centres.values())))
    write_gps(scene, dict(zip(centres, metres, strict=True)))
    by_gps = find(scene, tmp_path)
    found = find(scene, tmp_path, None, "0,0,0 0,0,1 13")
    assert found.metres_per_unit == pytest.approx(13) and found.crs == by_gps.crs
    np.testing.assert_allclose(
        found.metres_from_scene[:3, :3] / 13, by_gps.metres_from_scene[:3, :3] / SCALE, atol=1e-6
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("EPSG:32632\n1 2 3 10 10", "line 2: has 5 values"),
        ("EPSG:32632\n1 2 3 10 10 nothing.png a", "line 2: there is no photograph nothing.png"),
        ("EPSG:4258\n1 2 3 10 10 NAME a", "EPSG:4258 gives no metres"),
        ("EPSG:3857\n1 2 3 10 10 NAME a", "lengths in EPSG:3857, a map of the whole Earth, grow"),
        ("EPSG:2263\n1 2 3 10 10 NAME a", "EPSG:2263 is in feet or another unit"),
        ("somewhere\n1 2 3 10 10 NAME a", "coordinate system 'somewhere' is not known"),
        ("WGS84 UTM 61N\n1 2 3 10 10 NAME a", "coordinate system 'WGS84 UTM 61N' is not known"),
        ("+proj=utm +zone=0\n1 2 3 10 10 NAME a", "coordinate system .*zone=0' is not known"),
        (f"name,x,y,z\n{'a' * 200_000},1,2,3", "line 2: cannot be read"),
        ("EPSG:32632\n1 2 x 10 10 NAME a", "line 2: z is 'x', which is no number"),
        ("EPSG:32632\n1 2 3 10 10 NAME a\n1 2 4 10 10 NAME a", "line 3: a has another position"),
        ("EPSG:32632\n1 2 3 10 10 NAME a", "a is marked in one photograph"),
        ("EPSG:32632\n1 2 3 10 10 NAME a\n1 2 3 900 10 OTHER a", "line 3: 900, 10 is outside of"),
        ("EPSG:32632\n1 2 3 10 10 NAME a\n1 2 3 10 10 OTHER a", "meet in no point|are 1, where 3"),
        ("name,x,y,z\nnobody,1,2,3", "nobody has no mark"),
        ("name,x,y,z\n\u00b2,1,2,3", "\u00b2 has no mark"),
        ("EPSG:32632", "holds no control points"),
    ],
)
def test_bad_files_are_refused_in_one_sentence(scene, tmp_path, text, message):
    names = list(camera_centres(scene))
    (scene / "gcp_list.txt").write_text(text.replace("NAME", names[0]).replace("OTHER", names[5]))
    with pytest.raises(ConfigError, match=message) as refused:
        find(scene, tmp_path)
    assert str(scene / "gcp_list.txt") in str(refused.value)


@pytest.mark.parametrize("file", ["../elsewhere.csv", "/etc/hostname", "missing.csv"])
def test_files_outside_of_the_scene_or_missing_are_refused(scene, tmp_path, file):
    with pytest.raises(ConfigError, match=r"put the file into|cannot be read"):
        find(scene, tmp_path, file)


@pytest.mark.parametrize(
    "length",
    [
        "a b", "a b -1", "a a 2", "a 'b 2", "a b nan", "nothing here 2",
        "inf,0,0 0,0,0 2", "0,nan,0 0,0,0 2", "1e200,0,0 0,0,0 2", "0,0,0 1,0,0 1e300",
    ],
)  # fmt: skip
def test_bad_lengths_are_refused(scene, tmp_path, length):
    with pytest.raises(ConfigError, match="known_length"):
        find(scene, tmp_path, None, length)
