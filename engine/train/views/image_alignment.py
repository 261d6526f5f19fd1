"""How a camera moves so that a photograph shows the surface where its render does: direct image alignment.

Points of the surface, with the colors that they are rendered in, are projected into the photograph. Steps of
Gauss and Newton change the six numbers of the pose until the photograph has these colors there, as in
"Direct Sparse Odometry" (https://arxiv.org/abs/1607.02565). A gain and an offset for each channel are solved
along with them, so that exposure does not look like motion; what disagrees for other reasons counts little.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.spatial.transform import Rotation

from octasplat.engine.core.color import composite_over
from octasplat.engine.dataset import Camera
from octasplat.engine.dataset.image_motion import image_motion_by_pose
from octasplat.engine.dataset.view_frusta import rotate_vectors
from octasplat.engine.train.sampling.pixel_sampler import PixelSource

GAUSS_NEWTON_STEPS = 2
MAX_RESIDUAL_STEP_PX = 1.0
"""A step moves the middle point no farther; colors beyond say nothing about the slope here."""
DAMPING = 1e-3
"""Of the mean curvature, added to that of each of the six numbers: what hardly shows is left as it is."""
MIN_POINTS = 200
"""From fewer points nothing is said."""
OUTSIDE_PX = 1e6
"""Image points farther off are none."""
MIN_NOISE = 0.005
"""Display values; no smaller difference counts as usual."""


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """A rigid motion in camera coordinates: ``rotation @ x_cam + shift_cam``."""

    rotation: Float64[np.ndarray, "3 3"]
    shift_cam: Float64[np.ndarray, "3"]

    @classmethod
    def from_vector(cls, numbers: Float64[np.ndarray, "6"]) -> "RigidMotion":
        """Return the motion by a rotation vector (rad) and a shift (world units)."""
        return cls(Rotation.from_rotvec(numbers[:3]).as_matrix(), numbers[3:].copy())

    @property
    def to_vector(self) -> Float64[np.ndarray, "6"]:
        """Return the rotation vector and the shift."""
        return np.concatenate([Rotation.from_matrix(self.rotation).as_rotvec(), self.shift_cam])

    def __call__(self, points_cam: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
        """Return the points after the motion."""
        return rotate_vectors(points_cam, self.rotation) + self.shift_cam

    def scaled(self, share: float) -> "RigidMotion":
        """Return a share of the motion."""
        return RigidMotion.from_vector(share * self.to_vector)

    def compose(self, first: "RigidMotion") -> "RigidMotion":
        """Return the motion that does ``first``, then this one."""
        return RigidMotion(self.rotation @ first.rotation, self.rotation @ first.shift_cam + self.shift_cam)

    @property
    def inverse(self) -> "RigidMotion":
        """Return the inverse motion."""
        return RigidMotion(self.rotation.T, -self.rotation.T @ self.shift_cam)


@dataclass(frozen=True, eq=False)
class RenderedPoints:
    """Points of the surface in camera coordinates, and the display colors that they are rendered in."""

    points_cam: Float64[np.ndarray, "n 3"]
    rgb_srgb: Float64[np.ndarray, "n 3"]


@dataclass(frozen=True, eq=False)
class PhotographSamples:
    """Colors and gradients of a photograph at image points.

    Attributes:
        rgb_srgb: display colors; 0 where it shows nothing.
        gradient: of the colors, by x and y in pixels.
        valid: whether the photograph shows the point and counts there.
    """

    rgb_srgb: Float64[np.ndarray, "n 3"]
    gradient: Float64[np.ndarray, "n 3 2"]
    valid: Bool[np.ndarray, " n"]


PhotographFn = Callable[[Float64[np.ndarray, "n 2"]], PhotographSamples]
"""Gives what is shown at image points (px)."""


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Render and photograph under one motion; the render as exposed as fits best."""

    photograph: PhotographSamples
    exposed: Float64[np.ndarray, "n 3"]
    errors: Float64[np.ndarray, " n"]
    weights: Float64[np.ndarray, " n"]
    noise: float


def photograph_spline(
    dataset: PixelSource, view: int, size_px: tuple[int, int], background_srgb: Float32[np.ndarray, "3"]
) -> PhotographFn:
    """Return a view's photograph as a smooth function: its pixels are the coefficients of cubic B-splines."""
    width, height = size_px

    def look(xy_px: Float64[np.ndarray, "n 2"]) -> PhotographSamples:
        known = (np.abs(xy_px) < OUTSIDE_PX).all(axis=1)
        within = np.where(known[:, None], xy_px, 0.0) - 0.5  # pixel centers lie at halves
        first = np.floor(within).astype(np.int64) - 1
        # all sixteen coefficients inside
        inside = known & (first >= 0).all(axis=1) & (first + 3 < (width, height)).all(axis=1)
        first = np.clip(first, 0, (max(width - 4, 0), max(height - 4, 0)))
        x = np.minimum(first[:, None, None, 0] + np.arange(4)[None, None, :], width - 1)
        y = np.minimum(first[:, None, None, 1] + np.arange(4)[None, :, None], height - 1)
        which, y, x = (np.broadcast_to(a, (len(xy_px), 4, 4)).reshape(-1) for a in (np.array(view), y, x))
        rgb, alpha, weight = dataset.pixels(*_contiguous(which, y, x))
        colors = composite_over(rgb, alpha, background_srgb).reshape(-1, 4, 4, 3).astype(np.float64)
        valid = inside & (weight.reshape(-1, 16) > 0).all(axis=1)
        share = np.clip(within - first - 1, 0.0, 1.0)
        (by_x, slope_x), (by_y, slope_y) = _spline_weights(share[:, 0]), _spline_weights(share[:, 1])
        rows, row_slopes = (np.einsum("nyxc,nx->nyc", colors, taps) for taps in (by_x, slope_x))
        values = np.einsum("nyc,ny->nc", rows, by_y)
        slope = np.stack(
            [np.einsum("nyc,ny->nc", row_slopes, by_y), np.einsum("nyc,ny->nc", rows, slope_y)], axis=2
        )
        return PhotographSamples(np.where(valid[:, None], values, 0.0), slope, valid)

    return look


def align_camera(rendered: RenderedPoints, photograph: PhotographFn, camera: Camera) -> RigidMotion | None:
    """Return the motion of the camera's points after which the photograph agrees with the render.

    Returns:
        None where too few points are seen, or the agreement becomes no better.
    """
    points = rendered.points_cam
    if len(points) < MIN_POINTS:
        return None
    # around a panorama depths along the axis have both signs
    away = np.linalg.norm(points, axis=1) if camera.is_panorama else points[:, 2]
    depth = float(np.median(away))
    motion = RigidMotion.from_vector(np.zeros(6))
    before = now = _compare(rendered, photograph(camera.project(points)))
    for _ in range(GAUSS_NEWTON_STEPS):
        if now is None:
            return None
        motion = RigidMotion.from_vector(_gauss_newton_step(motion(points), now, camera, depth)).compose(
            motion
        )
        now = _compare(rendered, photograph(camera.project(motion(points))))
    if before is None or now is None:
        return None
    both = before.photograph.valid & now.photograph.valid  # only points that both show are compared
    better = both.sum() >= MIN_POINTS and _huber_cost(now, both, before.noise) < _huber_cost(
        before, both, before.noise
    )
    return motion if better else None


def _compare(rendered: RenderedPoints, shown: PhotographSamples) -> _Comparison | None:
    """Return the render beside the photograph's colors of its points; None where these are too few."""
    if int(shown.valid.sum()) < MIN_POINTS:
        return None
    weights = shown.valid.astype(np.float64)
    for _ in range(2):  # the second time without what disagrees
        exposed = _fit_exposure(rendered.rgb_srgb, shown.rgb_srgb, weights)
        errors = np.sqrt(np.square(exposed - shown.rgb_srgb).mean(axis=1))
        noise = max(MIN_NOISE, float(np.median(errors[shown.valid])))
        # Huber's weights: large errors count by their size, not its square
        weights = shown.valid / np.maximum(errors, noise)
    return _Comparison(shown, exposed, errors, weights, noise)


def _fit_exposure(
    rgb: Float64[np.ndarray, "n 3"], wanted: Float64[np.ndarray, "n 3"], weights: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3"]:
    """Return colors under the gain and offset of each channel that bring them closest to others."""
    share = (weights / weights.sum())[:, None]
    middle, wanted_middle = (share * rgb).sum(axis=0), (share * wanted).sum(axis=0)
    offset = rgb - middle
    variance = (share * offset**2).sum(axis=0)
    gain = (share * offset * (wanted - wanted_middle)).sum(axis=0) / np.maximum(variance, 1e-12)
    return gain * offset + wanted_middle


def _huber_cost(compared: _Comparison, which: Bool[np.ndarray, " n"], noise: float) -> float:
    """Return the mean error of points by Huber's function: squared up to ``noise``, linear beyond."""
    errors = compared.errors[which]
    return float(np.where(errors < noise, errors**2, noise * (2 * errors - noise)).mean())


def _gauss_newton_step(
    points_cam: Float64[np.ndarray, "n 3"], now: _Comparison, camera: Camera, depth: float
) -> Float64[np.ndarray, "6"]:
    """Return a Gauss-Newton step: a rotation vector and a shift of the camera's points.

    Shifts count in depths while it is solved, so that all six numbers are angles.
    """
    flow = image_motion_by_pose(points_cam, camera, depth)
    by_pose = np.einsum("nci,nik->nck", now.photograph.gradient, flow)
    slopes = np.zeros((len(points_cam), 3, 12))  # by the pose, and by each channel's gain and offset
    slopes[:, :, :6] = by_pose
    for channel in range(3):
        slopes[:, channel, 6 + channel] = -now.exposed[:, channel]
        slopes[:, channel, 9 + channel] = -1.0
    slopes[~now.photograph.valid] = 0.0
    weighted = slopes * now.weights[:, None, None]
    curvature = np.einsum("nck,ncl->kl", weighted, slopes)  # no BLAS: the same bits on any number of threads
    downhill = np.einsum("nck,nc->k", weighted, now.exposed - now.photograph.rgb_srgb)
    diagonal = curvature.diagonal()
    damping = np.where(np.arange(12) < 6, DAMPING * diagonal[:6].mean(), 0.0) + 1e-9 * diagonal + 1e-12
    step = np.linalg.solve(curvature + np.diag(damping), downhill)[:6]
    moved_px = np.linalg.norm(np.einsum("nik,k->ni", flow[now.photograph.valid], step), axis=1)
    # the median point moves no farther than the residual's slope holds
    step *= min(1.0, MAX_RESIDUAL_STEP_PX / max(float(np.median(moved_px)), 1e-12))
    return step * np.repeat([1.0, depth], 3)


def _spline_weights(
    share: Float64[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, "n 4"], Float64[np.ndarray, "n 4"]]:
    """Return weights of four neighbours between the second and the third, and their slopes."""
    f, g = share, 1 - share
    weights = np.stack([g**3, 3 * f**3 - 6 * f**2 + 4, 3 * g**3 - 6 * g**2 + 4, f**3], axis=1) / 6
    slopes = np.stack([-(g**2), 3 * f**2 - 4 * f, -(3 * g**2 - 4 * g), f**2], axis=1) / 2
    return weights, slopes


def _contiguous(*arrays: Int64[np.ndarray, " k"]) -> tuple[Int64[np.ndarray, " k"], ...]:
    return tuple(np.ascontiguousarray(array, np.int64) for array in arrays)
