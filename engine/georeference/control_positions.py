"""Positions in a scene of control points: by their marks in photographs, or by their names."""

from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.dataset.dataset import Dataset
from octasplat.engine.dataset.image_names import match_image_names
from octasplat.engine.dataset.images import read_image_info
from octasplat.engine.dataset.photograph_files import image_folder, photographs_below
from octasplat.engine.georeference.control_file import ControlFile, ControlPoint, Mark

MIN_ANGLE_RAD = np.deg2rad(0.5)
"""Rays that meet under a smaller angle say nothing of the distance."""
_Position = Float64[np.ndarray, "3"]


class ScenePoints:
    """Positions in a scene by name, in the coordinates of its user."""

    def __init__(self, dataset: Dataset, control: ControlFile | None) -> None:
        """Keep the scene; ``control`` holds the points that can be named."""
        self._dataset, self._control = dataset, control
        self._origin = np.array(dataset.origin_world)
        self._index = {view.name: index for index, view in enumerate(dataset.views)}
        by_path = {view.image_path: index for index, view in enumerate(dataset.views)}
        # with those that have no pose: else a name of theirs would be taken for a like one that has
        self._photographs = {
            name: by_path.get(path) for name, path in photographs_below(image_folder(dataset.root)).items()
        }
        self._points = {} if control is None else {point.name: point for point in control.points}
        marked = {mark.photograph for point in self._points.values() for mark in point.marks}
        # without names of points: one that is like a photograph's would leave it open whose it is
        self._marked = self._named_views(marked)

    def camera_centres(self) -> Float64[np.ndarray, "n 3"]:
        """Return the positions of all cameras."""
        return np.stack([view.origin_world for view in self._dataset.views]) + self._origin

    def control_position(self, point: ControlPoint) -> _Position | None:
        """Return where a control point is; None where too few of its photographs have a pose.

        Raises:
            ConfigError: it is marked once only, outside of a photograph, or where rays do not meet, or it has
                no marks and its name is nothing in the scene.
        """
        assert self._control is not None
        if not point.marks:
            found = self._by_name(point.name)
            if found is None and point.name not in self._named_views([point.name]):
                raise ConfigError(
                    f"{self._control.path}: {point.name} has no mark in a photograph, and there is no "
                    "photograph and no sparse point of that name; mark it in two photographs."
                )
            return found
        if len({mark.photograph for mark in point.marks}) < 2:
            raise ConfigError(
                f"{self._control.path}: {point.name} is marked in one photograph; mark it in another, too."
            )
        marks = [mark for mark in point.marks if self._marked.get(mark.photograph) is not None]
        return None if len({mark.photograph for mark in marks}) < 2 else self._triangulate(point.name, marks)

    def end_of_length(self, name: str) -> _Position:
        """Return the position that an end of a known length names.

        Raises:
            ConfigError: nothing has that name.
        """
        found = None
        if name in self._points:
            found = self.control_position(self._points[name])
        if found is None:
            found = _coordinates(name)
        if found is None:
            found = self._by_name(name)
        if found is None:
            raise ConfigError(
                f"known_length: {name} is no control point that photographs with poses show, no photograph "
                "with a pose, no number of a sparse point, and no x,y,z."
            )
        return found

    def _by_name(self, name: str) -> _Position | None:
        """Return the position of a photograph's camera or of a sparse point."""
        view = self._named_views([name]).get(name)
        if view is not None:
            return self._dataset.views[view].origin_world + self._origin
        points = self._dataset.points
        if name.isdecimal() and len(place := np.flatnonzero(points.ids == int(name))):
            return points.xyz_world[place[0]].astype(np.float64) + self._origin
        return None

    def _named_views(self, names: Collection[str]) -> dict[str, int | None]:
        """Return the views of the names that photographs have; None of those without a pose."""
        found = match_image_names(names, self._photographs.keys())
        by_file = {name: self._photographs[file] for name, file in found.items()}
        return by_file | {name: self._index[name] for name in names if name in self._index}

    def _triangulate(self, name: str, marks: Sequence[Mark]) -> _Position:
        assert self._control is not None
        poses, rays, ways = [], [], []
        for mark in marks:
            index = self._marked[mark.photograph]
            assert index is not None
            view = self._dataset.views[index]
            info = read_image_info(view.image_path)
            if not (0 <= mark.x_px <= info.width_px and 0 <= mark.y_px <= info.height_px):
                raise ConfigError(
                    f"{self._control.path}, line {mark.line}: {mark.x_px:g}, {mark.y_px:g} is outside of "
                    f"{mark.photograph}, which is {info.width_px}x{info.height_px}."
                )
            scale = (view.width_px / info.width_px, view.height_px / info.height_px)
            camera = self._dataset.cameras[view.camera_index]
            rays.append(camera.directions_cam(np.array([[mark.x_px, mark.y_px]]) * scale)[0])
            ways.append(view.rotation_cam_from_world.T @ rays[-1])
            poses.append(np.column_stack([view.rotation_cam_from_world, view.translation_cam_from_world]))
        agreement = np.array(ways) @ np.array(ways).T
        found = None
        if np.isfinite(agreement).all() and agreement.min() < np.cos(MIN_ANGLE_RAD):
            found = pycolmap.triangulate_multi_view_point(poses, np.array(rays))
        if found is not None:
            position = np.asarray(found, np.float64).reshape(3)
            if all(
                (pose[:, :3] @ position + pose[:, 3]) @ ray > 0 for pose, ray in zip(poses, rays, strict=True)
            ):
                return position + self._origin
        raise ConfigError(
            f"{self._control.path}: the marks of {name} meet in no point of the scene (photographs "
            f"{', '.join(mark.photograph for mark in marks[:3])}); correct them, or mark it in photographs "
            "that stand farther apart."
        )


def _coordinates(text: str) -> _Position | None:
    """Return the position that ``x,y,z`` says; None of another text."""
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        return None
    position = np.array([x, y, z])
    return position if np.isfinite(position).all() else None
