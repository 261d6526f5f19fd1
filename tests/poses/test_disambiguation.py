"""Two walks along walls that look alike, taken for one: GPS tells false pairs, and others map it anew."""

import shutil
import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from octasplat.engine.poses.ambiguous_structure import PairInliers, count_pair_inliers
from octasplat.engine.poses.disambiguation import (
    MappedModels,
    describe_gps_contradictions,
    disambiguate,
    leave_out_pairs_against_gps,
    leave_out_pairs_before_mapping,
    register_without_pairs_against_gps,
)
from octasplat.engine.poses.global_positioning import position_photographs
from octasplat.engine.poses.gps_contradictions import (
    find_gps_contradictions,
    read_ground_positions,
)

WALK = 24
"""Photographs of each walk, a meter apart: numbers 1 to 24 and 25 to 48."""
SPACING, ALIKE = 0.7, 9
"""Meters between landmarks of a wall; every ninth one looks like one of the other wall."""
CAMERA = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", 500.0, 640, 480)
LATITUDE, LONGITUDE = 48.1, 11.5
TURN = np.diag([-1.0, -1.0, 1.0])
"""About the vertical by half a turn: what a fold does to the second walk."""


@dataclass(frozen=True)
class Street:
    """What a folded model, its database, and the right models are made of."""

    database: Path
    folded: Any
    whole: Any
    parts: list[Any]


def poses(*, is_folded: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return centers and cam-from-world rotations: either walk looks away from the other."""
    x = np.arange(WALK) - (WALK - 1) / 2
    first = np.stack([x, np.full(WALK, -2.5), 0 * x], axis=1)
    away = np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]])  # right, down, ahead
    second = first + np.array([0.3, 0.4, 0.1])  # before its own wall
    centers = np.concatenate([first, second if is_folded else second @ TURN.T])
    return centers, np.stack([away] * WALK + [away if is_folded else away @ TURN.T] * WALK)


def landmarks() -> np.ndarray:
    """Return those of the first walk's wall."""
    side = np.arange(-16, 16, SPACING)
    x, z = (each.ravel() for each in np.meshgrid(side, np.arange(-2, 2.1, SPACING)))
    return np.stack([x, -10 + 0.5 * np.sin(7 * x + 3 * z), z], axis=1)


def reconstruct(numbers: Sequence[int], *, is_folded: bool) -> tuple[Any, dict[int, dict[int, int]]]:
    """Return a model, and for each photograph the place of a landmark in its list of points.

    Landmarks of the second wall come after those of the first. In the folded model the ones that are alike
    are one point, as the photographs of both walks see them in one place.
    """
    wall = landmarks()
    points = np.concatenate([wall, wall if is_folded else wall @ TURN.T])
    centers, rotations = poses(is_folded=is_folded)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(CAMERA)
    tracks: dict[int, list[tuple[int, int]]] = {}
    places: dict[int, dict[int, int]] = {}
    for number in numbers:
        k = number - 1
        in_camera = (points - centers[k]) @ rotations[k].T
        at_px = 500 * in_camera[:, :2] / in_camera[:, 2:] + (320, 240)
        is_own = (np.arange(len(points)) >= len(wall)) == (k >= WALK)
        seen = np.flatnonzero(
            is_own & (in_camera[:, 2] > 0) & (np.abs(at_px - (320, 240)) < (320, 240)).all(axis=1)
        )
        image = pycolmap.Image(
            name=f"{k}.jpg", keypoints=np.ascontiguousarray(at_px[seen]), camera_id=1, image_id=number
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotations[k]), -rotations[k] @ centers[k])
        model.add_image_with_trivial_frame(image, pose)
        places[number] = {landmark: place for place, landmark in enumerate(seen.tolist())}
        for landmark, place in places[number].items():
            is_alike = is_folded and landmark % len(wall) % ALIKE == 0
            tracks.setdefault(landmark % len(wall) if is_alike else landmark, []).append((number, place))
    for landmark, observations in tracks.items():
        track = pycolmap.Track()
        for number, place in observations:
            track.add_element(number, place)
        model.add_point3D(points[landmark], track, np.zeros(3, np.uint8))
    model.update_point_3d_errors()
    return model, places


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Street:
    """Photographs of both walks, all in one model that is folded, and matched as that model has it."""
    everything = range(1, 2 * WALK + 1)
    folded, places = reconstruct(everything, is_folded=True)
    whole, _ = reconstruct(everything, is_folded=False)
    path = tmp_path_factory.mktemp("street") / "mapping.db"
    centers, _ = poses(is_folded=False)
    rng = np.random.default_rng(0)
    wall = len(landmarks())
    with pycolmap.Database.open(path) as database:
        database.write_camera(CAMERA, use_camera_id=True)
        for number in everything:
            image = folded.image(number)
            database.write_image(
                pycolmap.Image(name=image.name, camera_id=1, image_id=number), use_image_id=True
            )
            at_px = np.array([point.xy for point in image.points2D])
            database.write_keypoints(number, at_px.astype(np.float32))
            north, east = np.degrees((centers[number - 1, [1, 0]] + rng.normal(0, 0.7, 2)) / 6_378_137)
            prior = pycolmap.PosePrior(
                corr_data_id=image.data_id,
                position=(LATITUDE + north, LONGITUDE + east / np.cos(np.radians(LATITUDE)), 500.0),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.WGS84,
            )
            database.write_pose_prior(prior)
        for a in everything:
            for b in range(a + 1, 2 * WALK + 1):
                is_across = a <= WALK < b
                shared = [k for k in places[a] if k % wall + wall * (b > WALK) in places[b]]
                shared = [k for k in shared if not is_across or k % wall % ALIKE == 0]
                if abs((a - 1) % WALK - (b - 1) % WALK) > 4 or len(shared) < 8:
                    continue
                geometry = pycolmap.TwoViewGeometry()
                second_from_first = (
                    folded.image(b).cam_from_world() * folded.image(a).cam_from_world().inverse()
                )
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.E = pycolmap.essential_matrix_from_pose(second_from_first)
                geometry.inlier_matches = np.array(
                    [(places[a][k], places[b][k % wall + wall * (b > WALK)]) for k in shared], np.uint32
                )
                database.write_two_view_geometry(a, b, geometry)
    parts = [reconstruct(everything[part], is_folded=False)[0] for part in (slice(WALK), slice(WALK, None))]
    return Street(path, folded, whole, parts)


def copied(street: Street, tmp_path: Path) -> Path:
    copy = tmp_path / "mapping.db"
    copy.write_bytes(street.database.read_bytes())
    return copy


def pairs_of(database: Path) -> int:
    with pycolmap.Database.open(database) as opened:
        return len(opened.read_two_view_geometries()[0])


def test_gps_of_a_database_is_read_as_meters(street: Street) -> None:
    ground_m = read_ground_positions(street.database)
    east, north = np.stack([ground_m[number] for number in range(1, WALK + 1)]).T
    # a walk of 23 m to the east, 5 m south of the other one, by GPS that is a meter off
    assert np.ptp(east) == pytest.approx(WALK - 1, abs=3) and np.ptp(north) < 5
    assert np.mean([ground_m[WALK + k][1] for k in range(1, WALK + 1)]) - north.mean() == pytest.approx(
        5, abs=1
    )


def test_false_pairs_are_those_of_the_two_walks(street: Street) -> None:
    ground_m = read_ground_positions(street.database)
    for models, is_folded in (([street.folded], True), (street.parts, False)):
        found = find_gps_contradictions(models, street.database, ground_m)
        assert (
            len(found.pairs) > 60 and (found.pairs[:, 0] <= WALK).all() and (found.pairs[:, 1] > WALK).all()
        )
        assert len(found.folded) == (2 * WALK if is_folded else 0)
    for right in ([street.whole], street.parts[:1]):
        assert len(find_gps_contradictions(right, street.database, ground_m).pairs) == 0


def test_photographs_of_all_models_count_in_large_captures(street: Street) -> None:
    mapped = MappedModels(street.parts)
    assert mapped.placed(99) == street.parts[0].num_reg_images() < 2 * WALK
    assert mapped.placed(100) == 2 * WALK


def test_false_pairs_are_left_out_before_mapping(street: Street, tmp_path: Path) -> None:
    database = copied(street, tmp_path)
    before, ground_m = pairs_of(database), read_ground_positions(database)
    removed = leave_out_pairs_before_mapping(database, ground_m, 0)
    with pycolmap.Database.open(database) as opened:
        left = [pycolmap.pair_id_to_image_pair(pair) for pair in opened.read_two_view_geometries()[0]]
    across = [pair for pair in left if pair[0] <= WALK < pair[1]]
    assert removed == before - len(left) > 60 and not across
    assert leave_out_pairs_before_mapping(copied(street, tmp_path), {}, 0) == 0


def test_rough_poses_of_photographs_without_matches(tmp_path: Path) -> None:
    with pycolmap.Database.open(tmp_path / "empty.db"):
        pass
    assert position_photographs(tmp_path / "empty.db", 0) is None


@pytest.mark.parametrize("comes_to", ["whole", "parts", "folded", "half"])
def test_models_that_agree_better_with_gps_are_taken(street: Street, tmp_path: Path, comes_to: str) -> None:
    database = copied(street, tmp_path)
    again = {
        "whole": [street.whole],
        "parts": street.parts,
        "folded": [street.folded],
        "half": street.parts[:1],  # loses too many photographs
    }[comes_to]
    mapped = leave_out_pairs_against_gps(
        MappedModels([street.folded]), database, read_ground_positions(database), lambda _copy: again
    )
    sentences = " ".join(describe_gps_contradictions(mapped))
    if comes_to in ("whole", "parts"):
        assert mapped.models is again and mapped.placed(2 * WALK) == 2 * WALK and mapped.gps_error_m is None
        assert sentences == (
            f"The model was folded: {mapped.left_out_pairs} false pairs of photographs that contradict their "
            "GPS were left out."
        )
        assert pairs_of(database) == pairs_of(street.database) - mapped.left_out_pairs
    else:
        assert mapped.models == [street.folded] and mapped.left_out_pairs == 0
        assert "displaced against each other (photographs there are 7." in sentences
        assert pairs_of(database) == pairs_of(street.database)


def test_trial_has_no_changes_of_one_that_was_killed(street: Street, tmp_path: Path) -> None:
    database, ground_m = copied(street, tmp_path), read_ground_positions(street.database)
    found = find_gps_contradictions([street.folded], database, ground_m)
    (tmp_path / "killed").mkdir()
    killed = Path(shutil.copyfile(database, tmp_path / "killed" / "trial.db"))
    with closing(sqlite3.connect(killed)) as left_open:  # its changes are in a file beside it
        left_open.execute("DELETE FROM two_view_geometries")
        left_open.commit()
        for path in killed.parent.iterdir():
            shutil.copyfile(path, tmp_path / path.name)
    assert (tmp_path / "trial.db-wal").stat().st_size > 0
    pairs: list[int] = []

    def map_again(trial: Path) -> list[Any]:
        pairs.append(pairs_of(trial))
        return [street.whole]

    leave_out_pairs_against_gps(MappedModels([street.folded]), database, ground_m, map_again)
    assert pairs == [pairs_of(street.database) - len(found.pairs)]


def test_right_model_is_mapped_once(street: Street) -> None:
    def never(_copy: Path) -> list[Any]:
        raise AssertionError("nothing is to be mapped again")

    ground_m = read_ground_positions(street.database)
    cases = (([street.whole], ground_m), (street.parts, ground_m), ([street.folded], {}), ([], ground_m))
    for models, ground in cases:
        mapped = disambiguate(models, street.database, ground, never)
        assert mapped == MappedModels(models) and describe_gps_contradictions(mapped) == []


@pytest.mark.parametrize("has_gps", [True, False])
@pytest.mark.parametrize("rest", ["nothing", "a true pair"])
def test_true_pairs_that_look_false_stay_by_gps(
    street: Street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rest: str, has_gps: bool
) -> None:
    """The test for conflicts takes a true pair for false while there are many false ones, or in any case."""
    database = copied(street, tmp_path)
    ground_m = read_ground_positions(database) if has_gps else {}

    def misled(votes: PairInliers) -> np.ndarray:
        is_misled = rest == "a true pair" or (votes.outliers > votes.inliers).any()
        return np.array([[1, 2]] * bool(is_misled), np.int64).reshape(-1, 2)

    def fold(copy: Path) -> list[Any]:
        copy.write_bytes(street.database.read_bytes())
        return [street.folded]

    monkeypatch.setattr("octasplat.engine.poses.disambiguation.find_false_pairs", misled)
    mapped = disambiguate([street.whole], database, ground_m, fold)
    assert mapped == MappedModels([street.whole if has_gps else street.folded])
    if has_gps:  # those that are false were left out
        votes = count_pair_inliers([street.whole], database)
        assert not ((votes.pairs[:, 0] <= WALK) & (votes.pairs[:, 1] > WALK)).any()


@pytest.mark.parametrize("is_folded", [False, True])
def test_registration_does_not_fold_again(street: Street, tmp_path: Path, is_folded: bool) -> None:
    database = copied(street, tmp_path)
    ground_m = read_ground_positions(database)
    before = MappedModels(street.parts, left_out_pairs=3)

    def go_on(given: Path) -> list[Any]:
        assert len(find_gps_contradictions(street.parts, given, ground_m).pairs) == 0
        if is_folded:  # by pairs of photographs that had no pose before
            given.write_bytes(street.database.read_bytes())
        return [street.folded if is_folded else street.whole]

    after = register_without_pairs_against_gps(before, database, ground_m, go_on)
    assert after == (before if is_folded else MappedModels([street.whole], left_out_pairs=3))
