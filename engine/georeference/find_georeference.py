"""The georeference of a scene with poses, from control points, GPS, or a known length."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.georeference import WGS84, Georeference, matrix_rows, similarity_scale
from octasplat.engine.dataset.dataset import Dataset
from octasplat.engine.dataset.photograph_gps import read_gps
from octasplat.engine.georeference.control_file import ControlFile
from octasplat.engine.georeference.control_positions import ScenePoints
from octasplat.engine.georeference.request import GeoreferenceRequest, KnownLength
from octasplat.engine.georeference.similarity import Fit, SimilarityError, fit_similarity
from octasplat.engine.render.upright import estimate_up

GPS_TOLERANCE, GPS_MAX_TOLERANCE_M = 0.2, 10.0
"""GPS positions may be so far off and still agree: as a share of their spread, and in metres."""
CONTROL_TOLERANCE = 0.05
"""The same of control points."""
MAX_SCALE = 1e12
"""Metres that a unit of a scene may have, and units that a metre may have, by a known length."""
_Positions = Float64[np.ndarray, "n 3"]


def find_georeference(
    dataset: Dataset, request: GeoreferenceRequest, note: Callable[[str], None]
) -> Georeference | None:
    """Return the georeference of a scene; None where nothing is asked for or known.

    Args:
        dataset: the photographs with their poses.
        request: what to find it from.
        note: receives sentences on what was found, and on GPS that is of no use if nobody asked for it.

    Raises:
        ConfigError: what was asked for cannot be had; the text names the file and says what to do.
    """
    if request.source == "off":
        return None
    points = ScenePoints(dataset, request.control)
    for path in request.unread:
        note(f"{path} is not read, since there are others; control_points={path.name} takes it instead.")
    found = None
    if request.source == "auto" and request.control is not None and _has_positions(request.control):
        found = _from_control_points(points, request.control, note)
    else:
        found = _from_gps(dataset, points, note, is_needed=request.source == "gps")
    if request.length is not None:
        found = _with_length(dataset, points, request.length, found)
    if found is not None:
        statement = "; ".join(found.facts())
        note(f"{statement[0].upper()}{statement[1:]}.")
    return found


def _has_positions(control: ControlFile) -> bool:
    return any(point.position is not None for point in control.points)


def _from_gps(
    dataset: Dataset, points: ScenePoints, note: Callable[[str], None], *, is_needed: bool
) -> Georeference | None:
    """Return the georeference by GPS; None where it is of no use and not needed."""
    read = [read_gps(view.image_path) for view in dataset.views]
    given = [index for index, position in enumerate(read) if position is not None]
    if not given and not is_needed:
        return None
    names = [dataset.views[index].name for index in given]
    try:
        anchor, metres = _about_anchor(np.array([read[i] for i in given], np.float64).reshape(-1, 3))
        fit = fit_similarity(
            points.camera_centres()[given],
            metres,
            tolerance=GPS_TOLERANCE,
            max_tolerance_m=GPS_MAX_TOLERANCE_M,
        )
    except SimilarityError as error:
        sentence = f"The GPS positions of the photographs in {dataset.root} {error}"
        if not is_needed:
            note(f"{sentence}, so that they are not used.")
            return None
        raise ConfigError(
            f"{sentence}; give control points or a known length, or leave --georeference gps out."
        ) from None
    return _georeference("GPS", fit, names, WGS84, anchor)


def _about_anchor(
    positions: Float64[np.ndarray, "n 3"],
) -> tuple[tuple[float, float, float], Float64[np.ndarray, "n 3"]]:
    """Return a round anchor amid latitudes, longitudes and heights, and these in metres about it."""
    if len(positions) == 0:
        raise SimilarityError("are 0, where 3 are the least")
    earth = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84)
    # about the first: longitudes jump at 180 degrees
    middle = np.median(earth.ellipsoid_to_enu(positions, *positions[0]), axis=0)
    latitude, longitude, height = earth.enu_to_ellipsoid(middle[None], *positions[0])[0].tolist()
    anchor = (round(latitude, 6), round(longitude, 6), round(height, 1))
    return anchor, np.asarray(earth.ellipsoid_to_enu(positions, *anchor), np.float64)


def _from_control_points(
    points: ScenePoints, control: ControlFile, note: Callable[[str], None]
) -> Georeference:
    names, scene, ground = [], [], []
    for point in control.points:
        if point.position is None:
            continue
        position = points.control_position(point)
        if position is None:
            few = "fewer than two of its photographs have poses" if point.marks else "it has no pose"
            note(f"{control.path}: {point.name} is left out, as {few}.")
            continue
        names.append(point.name)
        scene.append(position)
        ground.append(point.position)
    given = np.array(ground, np.float64).reshape(-1, 3)
    try:
        if control.crs == WGS84:
            _check_degrees(control.path, given)
            anchor, metres = _about_anchor(given[:, [1, 0, 2]])  # x is the longitude
        else:
            x, y, z = np.rint(np.median(given, axis=0)).tolist() if len(given) else (0.0, 0.0, 0.0)
            anchor = (x, y, z) if control.crs is not None else (0.0, 0.0, 0.0)
            metres = given - anchor
        fit = fit_similarity(np.array(scene).reshape(-1, 3), metres, tolerance=CONTROL_TOLERANCE)
    except SimilarityError as error:
        raise ConfigError(
            f"The control points in {control.path} {error}; check their coordinates and marks, or add some."
        ) from None
    return _georeference("control points", fit, names, control.crs, anchor)


def _check_degrees(path: Path, positions: _Positions) -> None:
    if len(positions) and not (np.abs(positions[:, :2]) <= (180, 90)).all():
        raise ConfigError(
            f"{path}: a point lies beyond 180 degrees of longitude or 90 of latitude; write the longitude "
            "first, or name the coordinate system that the points are in."
        )


def _georeference(
    method: str, fit: Fit, names: list[str], crs: str | None, anchor: tuple[float, float, float]
) -> Georeference:
    return Georeference(
        method=method,
        crs=crs,
        anchor=anchor if crs is not None else None,
        matrix=matrix_rows(fit.matrix),
        residuals=fit.residuals(names),
    )


def _with_length(
    dataset: Dataset, points: ScenePoints, length: KnownLength, found: Georeference | None
) -> Georeference:
    """Return a georeference in which a length is as known; position and turn are those of ``found``."""
    first, second = (points.end_of_length(name) for name in length.ends)
    units = math.dist(first, second)
    centres = points.camera_centres()
    if not units > 1e-9 * float(np.linalg.norm(np.ptp(centres, axis=0))):
        raise ConfigError(f"known_length: {' and '.join(length.ends)} are in one place; name other points.")
    scale, middle = length.metres / units, np.median(centres, axis=0)
    if not 1 / MAX_SCALE < scale < MAX_SCALE:
        raise ConfigError(
            f"known_length: {length.metres:g} m between {' and '.join(length.ends)} would make one unit of "
            f"the scene {scale:g} m; correct the length or its ends."
        )
    matrix = np.eye(4)
    if found is None:
        matrix[:3, :3] = scale * _level_frame(estimate_up(_rotations(dataset)))
        matrix[:3, 3] = -matrix[:3, :3] @ np.array(dataset.origin_world)
        return Georeference(method="known length", matrix=matrix_rows(matrix))
    before = found.metres_from_scene
    matrix[:3, :3] = before[:3, :3] * (scale / similarity_scale(before))
    # the cameras stay where they are
    matrix[:3, 3] = before[:3, :3] @ middle + before[:3, 3] - matrix[:3, :3] @ middle
    return found.model_copy(
        update={
            "method": f"{found.method} and known length",
            "matrix": matrix_rows(matrix),
            "residuals": None,
        }
    )


def _rotations(dataset: Dataset) -> Float64[np.ndarray, "n 3 3"]:
    return np.stack([view.rotation_cam_from_world for view in dataset.views])


def _level_frame(up: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return axes with z up as rows; x is what of the scene's x, or of its z, is level."""
    side = np.eye(3)[0 if abs(up[0]) < 0.9 else 2]
    x = side - (side @ up) * up
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
