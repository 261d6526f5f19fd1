"""False pairs of photographs by GPS: those that join parts of a model which GPS puts elsewhere.

:mod:`octasplat.engine.poses.ambiguous_structure` needs more true matches than false ones between two parts.
Where there are fewer, as between two sides of a street seen from two walks, GPS tells which are false.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.poses.ambiguous_structure import PairInliers, count_pair_inliers
from octasplat.engine.poses.local_georeferences import (
    MAX_TURN,
    NEIGHBORHOOD_SIZES,
    find_contradictions,
    fit_neighborhoods,
    rotation_angles,
)
from octasplat.engine.poses.pair_proposals import gps_positions_m

AGREEING_M = 5.0
"""A model of which no photograph is farther from its GPS is not asked further."""
_AGREEING_SHARE = 0.5
"""The same as a share of the spread of the positions."""
_MIN_INLIER_SHARE = 0.5
"""A pair that holds two parts together has this share of its matches in the model."""
_MIN_PHOTOGRAPHS = NEIGHBORHOOD_SIZES[0]

GroundPositions = Mapping[int, Float64[np.ndarray, "2"]]
"""Metres east and north, by the numbers of the photographs in the database."""


@dataclass(frozen=True, eq=False)
class GpsContradictions:
    """What contradicts GPS in the models of a mapping.

    Attributes:
        pairs: numbers of the photographs of false pairs: of one model, or of two that they would join.
        folded: numbers of the photographs around those of one model; none where no model is folded.
    """

    pairs: Int64[np.ndarray, "f 2"]
    folded: frozenset[int]


def read_ground_positions(database: Path) -> GroundPositions:
    """Return the places of the photographs that have GPS."""
    with pycolmap.Database.open(database) as photographs:
        places_m = gps_positions_m(photographs)
    if not places_m:
        return {}
    earth = pycolmap.GPSTransform()
    degrees = np.asarray(earth.ecef_to_ellipsoid(np.stack(list(places_m.values()))))
    # about the first: longitudes jump at 180 degrees
    middle = np.median(earth.ellipsoid_to_enu(degrees, *degrees[0]), axis=0)
    anchor = earth.enu_to_ellipsoid(middle[None], *degrees[0])[0]
    ground_m = np.asarray(earth.ellipsoid_to_enu(degrees, *anchor), np.float64)[:, :2]
    return dict(zip(places_m, ground_m, strict=True))


def gps_error_m(models: Sequence[Any], photographs: Collection[int], ground_m: GroundPositions) -> float:
    """Return how far some photographs are from GPS (root of the mean square), each model put there by itself.

    Those in parts of a few photographs, which fit anything, do not count.
    """
    off_m = [np.zeros(0)]
    for model in models:
        numbers = [number for number in _located(model, ground_m) if number in photographs]
        if len(numbers) >= _MIN_PHOTOGRAPHS:
            off_m.append(_distances_m(model, numbers, ground_m))
    every_m = np.concatenate(off_m)
    return float(np.sqrt(np.mean(every_m**2))) if len(every_m) else np.inf


def find_gps_contradictions(
    models: Sequence[Any], database: Path, ground_m: GroundPositions
) -> GpsContradictions:
    """Return the pairs that falsely join photographs which have poses.

    Args:
        models: ``pycolmap.Reconstruction`` each, that of most photographs first.
        database: with the matches; is only read.
        ground_m: by GPS.
    """
    of_model, may_be_folded = _photographs_by_model(models, ground_m)
    if len(set(of_model.values())) < 2 and not any(may_be_folded):
        return GpsContradictions(np.zeros((0, 2), np.int64), frozenset())
    photographs = _Photographs(models, of_model, count_pair_inliers(models, database), ground_m)
    is_false = photographs.find_false(database, np.array(may_be_folded))
    return GpsContradictions(photographs.votes.pairs[is_false], photographs.around(is_false))


def find_turned_pairs(model: Any, database: Path, ground_m: GroundPositions) -> Int64[np.ndarray, "f 2"]:
    """Return the pairs that falsely join photographs of a model that has poses alone, and few points.

    Their neighborhoods are turned against each other by GPS, and their matches say so, too. All matches of a
    pair count as links.

    Args:
        model: a ``pycolmap.Reconstruction``.
        database: with the matches; is only read.
        ground_m: by GPS.
    """
    of_model, may_be_folded = _photographs_by_model([model], ground_m)
    if not any(may_be_folded):
        return np.zeros((0, 2), np.int64)
    with pycolmap.Database.open(database) as source:
        ids, counts = source.read_two_view_geometry_num_inliers()
    pairs = np.array([pycolmap.pair_id_to_image_pair(pair_id) for pair_id in ids], np.int64).reshape(-1, 2)
    matches = np.array(counts, np.int64)
    votes = PairInliers(pairs, matches, np.zeros_like(matches)).select(matches > 0)
    photographs = _Photographs([model], of_model, votes, ground_m)
    return np.asarray(photographs.votes.pairs[photographs.find_turned(database)])


def find_outliers_against_gps(
    model: Any, votes: PairInliers, database: Path, ground_m: GroundPositions
) -> Int64[np.ndarray, "f 2"]:
    """Return the pairs that a model contradicts, and GPS as well: false ones that it was not led by.

    Args:
        model: a ``pycolmap.Reconstruction``.
        votes: counts of its pairs.
        database: with the matches; is only read.
        ground_m: by GPS.
    """
    of_model, _ = _photographs_by_model([model], ground_m)
    if not of_model:
        return votes.pairs[:0]
    photographs = _Photographs([model], of_model, votes, ground_m)
    return np.asarray(photographs.votes.pairs[photographs.find_false_outliers(database)])


def _photographs_by_model(
    models: Sequence[Any], ground_m: GroundPositions
) -> tuple[dict[int, int], list[bool]]:
    """Return the first model of each photograph with GPS, and which models may be folded.

    Models of few such photographs do not count.
    """
    of_model: dict[int, int] = {}
    may_be_folded = []
    for place, model in enumerate(models):
        numbers = _located(model, ground_m)
        is_enough = len(numbers) >= _MIN_PHOTOGRAPHS
        may_be_folded.append(is_enough and not _agrees(model, numbers, ground_m))
        if is_enough:
            of_model = dict.fromkeys(numbers, place) | of_model
    return of_model, may_be_folded


class _Photographs:
    """The photographs that have GPS and a pose, and what GPS says of their neighborhoods.

    Attributes:
        votes: counts of the pairs of these photographs.
    """

    def __init__(
        self,
        models: Sequence[Any],
        of_model: Mapping[int, int],
        votes: PairInliers,
        ground_m: GroundPositions,
    ) -> None:
        numbers = sorted(of_model)
        self._numbers = np.array(numbers, np.int64)
        self.votes = votes.select(np.asarray(np.isin(votes.pairs, self._numbers).all(axis=1)))
        self._links = np.searchsorted(self._numbers, self.votes.pairs)
        self._model = np.array([of_model[number] for number in numbers])
        self._images = [models[of_model[number]].image(number) for number in numbers]
        self._cameras = [
            models[of_model[number]].cameras[image.camera_id]
            for number, image in zip(numbers, self._images, strict=True)
        ]
        self._centers = np.stack([image.projection_center() for image in self._images])
        self._rotations = np.stack([image.cam_from_world().rotation.matrix() for image in self._images])
        self._ground_m = np.stack([ground_m[number] for number in numbers])
        self._fits = fit_neighborhoods(
            self._links, self.votes.inliers, self._centers, self._rotations, self._ground_m
        )

    def find_false(self, database: Path, may_be_folded: Bool[np.ndarray, " m"]) -> Bool[np.ndarray, " p"]:
        """Return which pairs are false."""
        links, votes, fits = self._links, self.votes, self._fits
        is_turned, is_displaced = find_contradictions(fits, links, self._centers, self._ground_m)
        is_inside = self._is_inside()
        is_asked = np.where(
            is_inside, is_turned & may_be_folded[self._model[links[:, 0]]], fits.is_known[links].all(axis=1)
        )
        holds = votes.inliers > _MIN_INLIER_SHARE * (votes.inliers + votes.outliers)
        is_false = is_inside & is_displaced & may_be_folded[self._model[links[:, 0]]] & holds
        angles = self._angles_to_gps(database, np.flatnonzero(is_asked))
        is_false[is_asked] = np.where(np.isnan(angles), (is_inside & holds)[is_asked], angles > MAX_TURN)
        return is_false

    def find_turned(self, database: Path) -> Bool[np.ndarray, " p"]:
        """Return which pairs turn the second camera otherwise than GPS does, and their neighborhoods, too."""
        is_turned, _ = find_contradictions(self._fits, self._links, self._centers, self._ground_m)
        # no number is more than another one
        is_turned[is_turned] = self._angles_to_gps(database, np.flatnonzero(is_turned)) > MAX_TURN
        return is_turned

    def find_false_outliers(self, database: Path) -> Bool[np.ndarray, " p"]:
        """Return which pairs have more outliers than inliers, and a turn that contradicts GPS."""
        is_false = (self.votes.outliers > self.votes.inliers) & self._fits.is_known[self._links].all(axis=1)
        # no number is more than another one
        is_false[is_false] = self._angles_to_gps(database, np.flatnonzero(is_false)) > MAX_TURN
        return is_false

    def around(self, is_false: Bool[np.ndarray, " p"]) -> frozenset[int]:
        """Return the numbers of the photographs around the false pairs inside of models."""
        ends = np.unique(self._links[is_false & self._is_inside()])
        return frozenset(self._numbers[self._fits.around(ends)].tolist())

    def _is_inside(self) -> Bool[np.ndarray, " p"]:
        return np.asarray(self._model[self._links[:, 0]] == self._model[self._links[:, 1]])

    def _angles_to_gps(self, database: Path, asked: Int64[np.ndarray, " q"]) -> Float64[np.ndarray, " q"]:
        """Return by how much the matches of pairs turn the second camera otherwise than GPS does.

        NaN where the matches leave the turn open.
        """
        cam_from_ground = self._rotations @ self._fits.rotation.transpose(0, 2, 1)
        found = np.full((len(asked), 3, 3), np.nan)
        with pycolmap.Database.open(database) as source:
            keypoints = {
                place: source.read_keypoints(int(self._numbers[place]))[:, :2].astype(np.float64)
                for place in np.unique(self._links[asked]).tolist()
            }
            for row, (a, b) in enumerate(self._links[asked].tolist()):
                geometry = source.read_two_view_geometry(int(self._numbers[a]), int(self._numbers[b]))
                if pycolmap.estimate_two_view_geometry_pose(
                    self._cameras[a], keypoints[a], self._cameras[b], keypoints[b], geometry
                ):
                    found[row] = geometry.cam2_from_cam1.rotation.matrix()
        a, b = self._links[asked].T
        by_gps = cam_from_ground[b] @ cam_from_ground[a].transpose(0, 2, 1)
        return rotation_angles(found, by_gps)


def _located(model: Any, ground_m: GroundPositions) -> list[int]:
    """Return the numbers of the photographs of a model that have GPS, in order."""
    return sorted(number for number in model.reg_image_ids() if number in ground_m)


def _agrees(model: Any, numbers: Sequence[int], ground_m: GroundPositions) -> bool:
    """Return whether every photograph of a model is near its GPS."""
    ground = np.stack([ground_m[number] for number in numbers])
    spread_m = float(np.sqrt(np.mean(np.sum((ground - ground.mean(axis=0)) ** 2, axis=1))))
    off_m = _distances_m(model, numbers, ground_m)
    return float(off_m.max()) <= min(AGREEING_M, _AGREEING_SHARE * spread_m)


def _distances_m(model: Any, numbers: Sequence[int], ground_m: GroundPositions) -> Float64[np.ndarray, " n"]:
    """Return how far photographs are from GPS where the best similarity puts them."""
    ground = np.stack([ground_m[number] for number in numbers])
    centers = np.stack([model.image(number).projection_center() for number in numbers])
    source, target = centers - centers.mean(axis=0), ground - ground.mean(axis=0)
    # a plane in the scene is the ground: Umeyama, "Least-squares estimation of transformation parameters
    # between two point patterns" (1991), where heights are zero, so that no reflection is to be ruled out
    left, widths, right = np.linalg.svd(target.T @ source, full_matrices=False)
    scale = widths.sum() / max(float((source**2).sum()), np.finfo(np.float64).tiny)
    return np.asarray(np.linalg.norm(scale * source @ (left @ right).T - target, axis=1))
