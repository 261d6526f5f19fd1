"""A lens that moved between photographs: each gets the place of its own picture; runs in COLMAP's process.

All photographs of a model that share a camera begin with its lens. A bundle adjustment then finds poses and
points anew, and for each photograph where the principal point is; focal lengths and distortion stay, as
without them known the world could be bent (Pollefeys, Koch and Van Gool, "Self-Calibration and Metric
Reconstruction in spite of Varying and Unknown Internal Camera Parameters", 1999). The result is laid over
the given model by the similarity that brings the cameras closest.

Not done: rigs of several cameras; focal lengths that change, as by autofocus.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.colmap_binding import pycolmap
from octasplat.engine.core.events import EventListener
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.colmap_reading import load_model
from octasplat.engine.poses.config import FOUND_FOLDER, LENSES_STAGE, RECORD_FILE, PoseSearchRequest
from octasplat.engine.poses.lens_check import MIN_OBSERVATIONS
from octasplat.engine.poses.whole_files import write_model
from octasplat.engine.poses.workspace import progress_stage

MIN_GAIN = 0.15
"""The reprojection error must fall by this share, or the given model stays."""
MAX_SHIFT = 0.08
"""Of the longer side; a principal point that would move farther is not known from its photograph."""
MIN_OBSERVATIONS_TO_MOVE = 15
"""Photographs that show fewer points stay where they are."""
MAX_TURN_ERROR = 0.02
"""Radians by which the turn about the longest axis of the cameras may be uncertain, for it to be taken."""
_ITERATIONS = 3
_MAX_SOLVER_STEPS = 50


def write_per_view_principal_points(
    request: PoseSearchRequest, folder: Path, progress: EventListener
) -> None:
    """Write the model with a lens for each photograph, where that explains far more, and what it is worth.

    Args:
        request: says where to work.
        folder: of the model.
        progress: hears the progress.
    """
    pycolmap.logging.minloglevel = 2
    given: Any = load_model(folder).reconstruction
    # map coordinates are so large beside distances in the scene that an adjustment there ends too soon
    middle = _middle(given)
    _move(given, -middle)
    found = request.work / FOUND_FOLDER
    found.mkdir()
    with progress_stage(LENSES_STAGE, _ITERATIONS + 1, progress) as at:
        shared, before = _adjust_shared_principal_point(given)
        at(1)
        model = (
            None
            if shared is None
            else _adjust_per_view_principal_points(shared, given, before, lambda done: at(1 + done))
        )
    after = before if model is None else model.compute_mean_reprojection_error()
    if model is None or not after <= (1 - MIN_GAIN) * before:
        write_json(found / RECORD_FILE, {"lenses": None})
        return
    _move(model, middle)
    write_model(model, found)
    shifts_px = [_shift_px(model, given, i) for i in sorted(model.images)]
    facts = {
        "reprojection_px_before": float(before),
        "reprojection_px": float(after),
        "shift_px_median": float(np.median(shifts_px)),
        "shift_px_most": float(np.max(shifts_px)),
    }
    write_json(found / RECORD_FILE, {"lenses": facts})


def _middle(model: Any) -> Float64[np.ndarray, " 3"]:
    """Return the mean of where the photographs of a model were taken; the origin without any."""
    posed = [model.images[i] for i in sorted(model.images) if model.images[i].has_pose]
    centres = [image.projection_center() for image in posed]
    return np.asarray(np.mean(centres, axis=0)) if centres else np.zeros(3)


def _move(model: Any, by: Float64[np.ndarray, " 3"]) -> None:
    """Move a model, cameras and points."""
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), by))


def _adjust_shared_principal_point(given: Any) -> tuple[Any | None, float]:
    """Return the model bundle-adjusted with the given lenses, and its mean error (px); None where it fails.

    It is the baseline: an improvement that it already reaches is not due to the lenses.
    """
    if any(len(frame.data_ids) > 1 for frame in given.frames.values()):
        return None, 0.0
    model = _split_cameras(given)
    model.update_point_3d_errors()
    if not _bundle_adjust(model, set(model.images), model.compute_mean_reprojection_error()):
        return None, 0.0
    model.update_point_3d_errors()
    return model, model.compute_mean_reprojection_error()


def _adjust_per_view_principal_points(
    shared: Any, given: Any, error_px: float, on_count: Callable[[int], None]
) -> Any | None:
    """Return ``shared`` adjusted with lenses per view and aligned to ``given``; None where it fails."""
    # too few observations to know a lens from
    fixed = {i for i, image in shared.images.items() if image.num_points3D < MIN_OBSERVATIONS}
    for k in range(_ITERATIONS):
        model = _split_cameras(shared)
        if not _bundle_adjust(model, fixed, error_px):
            return None
        _align_to_given(model, given)
        on_count(k + 1)
        # those whose principal point ran away get the shared one again
        astray = {i for i in model.images if _shift_px(model, given, i) > MAX_SHIFT * _side_px(model, i)}
        if not astray:
            model.update_point_3d_errors()
            return model
        fixed |= astray
    return None


def _split_cameras(given: Any) -> Any:
    """Return the model with a camera and a rig of its own for each photograph that has a pose."""
    model: Any = pycolmap.Reconstruction()
    for number, i in enumerate(sorted(k for k, image in given.images.items() if image.has_pose)):
        image, camera = given.images[i], given.cameras[given.images[i].camera_id]
        own = pycolmap.Camera(
            camera_id=number + 1,
            model=camera.model_name,
            width=camera.width,
            height=camera.height,
            params=camera.params,
        )
        model.add_camera_with_trivial_rig(own)
        spots = pycolmap.Point2DList([pycolmap.Point2D(spot.xy) for spot in image.points2D])
        copy = pycolmap.Image(name=image.name, points2D=spots, camera_id=number + 1, image_id=i)
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    for _, point in sorted(given.points3D.items()):
        model.add_point3D(point.xyz, point.track, point.color)
    return model


def _bundle_adjust(model: Any, fixed: set[int], error_px: float) -> bool:
    """Find points, poses and principal points anew, those of the photographs ``fixed`` left out."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = False
    options.refine_principal_point = True
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = 2 * error_px  # twice the mean error: outliers count little
    options.ceres.solver_options.num_threads = 1  # more would add up in the order in which they come
    options.ceres.solver_options.max_num_iterations = _MAX_SOLVER_STEPS
    options.ceres.solver_options.function_tolerance = 1e-5
    config = pycolmap.BundleAdjustmentConfig()
    for i, image in model.images.items():
        config.add_image(i)
        if i in fixed:
            config.set_constant_cam_intrinsics(image.camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    return bool(summary.is_solution_usable())


def _align_to_given(model: Any, given: Any) -> None:
    """Align the model to the given cameras; those with too few observations keep their given poses.

    Cameras on a line, as on a rail, leave the turn about it open: their model stays in the world of the two
    cameras that the adjustment has held.
    """
    kept = [i for i in sorted(model.images) if model.images[i].num_points3D >= MIN_OBSERVATIONS_TO_MOVE]
    ours, theirs = (
        np.array([source.images[i].projection_center() for i in kept]) for source in (model, given)
    )
    similarity = pycolmap.estimate_sim3d(ours, theirs)
    if similarity is not None and _turn_error(similarity, ours, theirs) <= MAX_TURN_ERROR:
        model.transform(similarity)
    for i in sorted(set(model.images) - set(kept)):
        model.images[i].frame.rig_from_world = given.images[i].cam_from_world()


def _turn_error(
    similarity: Any, ours: Float64[np.ndarray, "n 3"], theirs: Float64[np.ndarray, "n 3"]
) -> float:
    """Return how far a similarity of cameras may be turned about their longest axis, in radians."""
    matrix = similarity.matrix()
    off = ours @ matrix[:, :3].T + matrix[:, 3] - theirs
    across = float(np.linalg.svd(theirs - theirs.mean(axis=0), compute_uv=False)[1])
    # an error of each position turns a set of that width (a root of a sum of squares) by so much
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) / max(across, np.finfo(np.float64).tiny)


def _shift_px(model: Any, given: Any, i: int) -> float:
    own, shared = model.cameras[model.images[i].camera_id], given.cameras[given.images[i].camera_id]
    return float(np.hypot(own.principal_point_x - shared.principal_point_x,
                          own.principal_point_y - shared.principal_point_y))  # fmt: skip


def _side_px(model: Any, i: int) -> int:
    camera = model.cameras[model.images[i].camera_id]
    return int(max(camera.width, camera.height))
