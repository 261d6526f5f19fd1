"""Photographs of a given model that may stand in the wrong place: asked, and moved where they do."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import EventListener
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.colmap_reading import load_model
from octasplat.engine.dataset.image_names import match_image_names
from octasplat.engine.dataset.images import read_image_info
from octasplat.engine.poses.config import (
    FEATURES,
    FOUND_FOLDER,
    INLIER_DISTANCE_PX,
    MATCHES,
    MAX_IMAGE_SIDE_PX,
    MAX_WITNESSES,
    PLACING_STAGE,
    RECORD_FILE,
    GivenModel,
    PoseSearchRequest,
)
from octasplat.engine.poses.features import create_database, extract_features, match_pairs
from octasplat.engine.poses.pose_estimation import (
    Matches,
    Pose,
    collect_matches,
    estimate_pose,
    is_explained_by_pose,
)
from octasplat.engine.poses.whole_files import write_model
from octasplat.engine.poses.workspace import link_photographs, progress_stage


def repair_misplaced(request: PoseSearchRequest, given: GivenModel, progress: EventListener) -> None:
    """Write the model with the photographs moved that stand in the wrong place, and the names of these.

    Few others are asked first, from all around: not those nearby, as the pose may have been made by false
    matches with them. Where the given pose does not fit what these say, more are asked.

    Args:
        request: says where to work and what with.
        given: the model, and the photographs in doubt.
        progress: hears the progress.
    """
    pycolmap.logging.minloglevel = 2  # its warnings are of use to nobody here
    others = np.setdiff1d(np.arange(len(given.names)), np.array(given.doubtful, dtype=np.int64)).tolist()
    asked = _evenly_spaced(others, request.config.first_witnesses)
    more = _evenly_spaced([k for k in others if k not in asked], MAX_WITNESSES - len(asked))
    hearing = _PoseVerifier(request, given, sorted({*given.doubtful, *asked, *more}), progress)
    hearing.match_with(given.doubtful, asked)
    left = [k for k in given.doubtful if not hearing.is_consistent(k)]
    if left and more:
        hearing.match_with(left, more)
    moved: dict[int, Pose] = {}
    with progress_stage(PLACING_STAGE, len(left), progress) as at:
        for done, k in enumerate(left):
            if (new := hearing.corrected_pose(k)) is not None:
                moved[k] = new
            at(done + 1)
    found = request.work / FOUND_FOLDER
    found.mkdir()
    if moved:
        for k, pose in moved.items():
            _set_pose(hearing.model, hearing.images[k], pose)
        write_model(hearing.model, found)
    write_json(found / RECORD_FILE, {"moved": [given.names[k] for k in sorted(moved)]})


class _PoseVerifier:
    """Checks doubtful poses against the matches with other photographs.

    Photographs are those of the given model, by their numbers there. The database has those alone that are
    read here, numbered from 1 on in the same order.

    Args:
        request: says where to work and what with.
        given: the model, and the photographs in doubt.
        read: photographs that may be matched, in order.
        progress: hears the progress.

    Attributes:
        model: as it is given.
        images: of the model, by photograph.
    """

    def __init__(
        self, request: PoseSearchRequest, given: GivenModel, read: Sequence[int], progress: EventListener
    ) -> None:
        self.model: Any = load_model(given.model).reconstruction
        # as the scene was opened: models may spell names of files otherwise, or leave suffixes out
        files = match_image_names([image.name for image in self.model.images.values()], given.names)
        by_name = {files.get(image.name): image for image in self.model.images.values()}
        self.images: dict[int, Any] = {k: by_name[name] for k, name in enumerate(given.names)}
        self._config, self._tell, self._threads = request.config, progress, request.threads or -1
        self._doubtful = frozenset(given.doubtful)
        self._photographs, self._database = request.work / "photographs", request.work / "database.db"
        self._place = {k: place for place, k in enumerate(read)}
        names = [request.names[k] for k in read]
        self._aliases = link_photographs(request.images, names, self._photographs, progress)
        infos = [read_image_info(request.images / name) for name in names]
        self._sizes_px = [(info.width_px, info.height_px) for info in infos]
        self._one_camera = len(set(self._sizes_px)) == 1
        self._matched_pairs: set[int] = set()
        made = create_database(self._database, self._photographs, self._aliases, one_camera=self._one_camera)
        if made != self._aliases:  # those after one that is missing would be others
            unread = [name for name, alias in zip(names, self._aliases, strict=True) if alias not in made]
            raise DatasetError(f"COLMAP cannot read {', '.join(unread[:3])}.")

    def match_with(self, doubtful: Sequence[int], witnesses: Sequence[int]) -> None:
        """Match photographs in doubt with others."""
        new = sorted({*doubtful, *witnesses} - self._matched_pairs)
        with progress_stage(FEATURES, len(new), self._tell) as at:
            extract_features(
                self._database,
                self._photographs,
                [self._aliases[self._place[k]] for k in new],
                self._config,
                thorough=False,
                one_camera=self._one_camera,
                threads=self._threads,
                on_count=at,
            )
        self._matched_pairs.update(new)
        places = [(self._place[a], self._place[b]) for a in doubtful for b in witnesses]
        pairs = sorted((min(pair), max(pair)) for pair in places)
        with progress_stage(MATCHES, len(pairs), self._tell) as at:
            match_pairs(
                self._database,
                self._aliases,
                pairs,
                self._config,
                thorough=False,
                threads=self._threads,
                on_count=at,
            )

    def is_consistent(self, k: int) -> bool:
        """Return whether the given pose of a photograph agrees with the matches so far."""
        matches = self._matches(k)
        return matches is not None and is_explained_by_pose(
            self._given_pose(k), matches, self._inlier_distance(k)
        )

    def corrected_pose(self, k: int) -> Pose | None:
        """Return the corrected pose of a doubtful photograph; None where the given one stays."""
        if len(self.images[k].frame.data_ids) > 1:  # it would take the other cameras of its rig along
            return None
        matches = self._matches(k)
        if matches is None:
            return None
        return estimate_pose(matches, self._given_pose(k), self._inlier_distance(k), seed=self._config.seed)

    def _matches(self, k: int) -> Matches | None:
        # other doubtful photographs say nothing reliable
        asked = {k, *self._matched_pairs} - (self._doubtful - {k})
        images = {self._place[other] + 1: self.images[other] for other in asked}
        return collect_matches(self._place[k] + 1, self.model, images, self._database, self._sizes_px)

    def _given_pose(self, k: int) -> Pose:
        pose = self.images[k].cam_from_world()
        return pose.rotation.matrix(), np.asarray(pose.translation)

    def _inlier_distance(self, k: int) -> float:
        """Return the distance at which a match is an inlier, in units of the focal length."""
        camera = self.model.cameras[self.images[k].camera_id]
        width_px, height_px = self._sizes_px[self._place[k]]
        shrunk = min(1.0, MAX_IMAGE_SIDE_PX / max(width_px, height_px))
        return float(INLIER_DISTANCE_PX * camera.width / width_px / shrunk / camera.mean_focal_length())


def _evenly_spaced(numbers: Sequence[int], count: int) -> list[int]:
    """Return at most so many of some numbers, evenly spaced."""
    if count <= 0 or not numbers:
        return []
    chosen = np.unique(np.linspace(0, len(numbers) - 1, count).round().astype(np.int64))
    return [numbers[k] for k in chosen.tolist()]


def _set_pose(model: Any, image: Any, pose: Pose) -> None:
    """Set another pose of an image and delete its observations, which belong to the former pose."""
    cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[0]), pose[1])
    # the camera's place in its rig stays
    cam_from_rig = image.cam_from_world() * image.frame.rig_from_world.inverse()
    image.frame.rig_from_world = cam_from_rig.inverse() * cam_from_world
    for index, point in enumerate(image.points2D):
        if point.has_point3D():
            model.delete_observation(image.image_id, index)
