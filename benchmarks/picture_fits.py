"""Fits that bring a rendered picture closest to a photograph: color, gain, shift, homography, local motion.

Each returns the picture after the fit, and most of them the numbers that were found, so that the PSNR which
is left tells how much one cause costs: what a fit of colors takes away is exposure and color, what a shift
of the whole picture takes away is the pose, what a homography takes away is pose and lens, and what a motion
of each place of its own takes away is mostly geometry. Pictures are display values.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

Picture = Float32[np.ndarray, "h w 3"]
Weight = Float32[np.ndarray, "h w"]

GAIN_GRID = 4
"""Knots across and down of the local gain."""
MAX_STEPS = 12
ENOUGH_PX = 1e-3
"""A step that moves the corners by less is the last one."""
LOCAL_SIGMA_PX = 8.0
"""Standard deviation of the windows in which the local motion is found."""
MAX_LOCAL_PX = 3.0
LOCAL_STEPS = 4


@dataclass(frozen=True)
class Motion:
    """A motion of a whole picture.

    Attributes:
        picture: the render after it.
        matrix: takes a pixel of the photograph to the place of the render that shows the same (about the
            middle, in halves of the longer side).
        shift_px: of the middle of the picture, across and down.
        corner_px: largest distance by which a corner moves.
    """

    picture: Picture
    matrix: Float64[np.ndarray, "3 3"]
    shift_px: tuple[float, float]
    corner_px: float


def fit_affine_color(render: Picture, reference: Picture, weight: Weight) -> Picture:
    """Return the render under the 3 x 3 matrix and the offset that bring its colors closest, clipped."""
    if weight.sum() <= 0:
        return render.copy()
    known = np.concatenate([render.reshape(-1, 3), np.ones((weight.size, 1))], axis=1)
    share = weight.reshape(-1, 1).astype(np.float64)
    normal = known.T @ (share * known) + 1e-9 * share.sum() * np.eye(4)
    matrix = np.linalg.solve(normal, known.T @ (share * reference.reshape(-1, 3)))
    return np.clip(known @ matrix, 0, 1).reshape(render.shape).astype(np.float32)


def fit_local_gain(render: Picture, reference: Picture, weight: Weight, knots: int = GAIN_GRID) -> Picture:
    """Return the render under the gains of each channel, bilinear between knots, that bring it closest.

    ``knots`` across and down lie evenly from edge to edge. Little light around a knot leaves its gain at
    that of the whole picture.
    """
    if weight.sum() <= 0:
        return render.copy()
    height, width = weight.shape
    down, across = _hat_functions(height, knots), _hat_functions(width, knots)
    shown = render.astype(np.float64)
    fitted = np.empty_like(shown)
    for channel in range(3):
        value, wanted = shown[..., channel], reference[..., channel].astype(np.float64)
        energy, product = weight * value * value, weight * value * wanted
        gain = product.sum() / max(float(energy.sum()), 1e-12)
        normal = np.einsum("yx,ya,xb,yc,xd->abcd", energy, down, across, down, across, optimize=True)
        normal = normal.reshape(knots**2, knots**2)
        held = 1e-4 * normal.diagonal().mean() + 1e-12
        right = np.einsum("yx,ya,xb->ab", product, down, across, optimize=True).reshape(-1) + held * gain
        gains = np.linalg.solve(normal + held * np.eye(knots**2), right).reshape(knots, knots)
        fitted[..., channel] = value * (down @ gains @ across.T)
    return np.clip(fitted, 0, 1).astype(np.float32)


def fit_shift(render: Picture, reference: Picture, weight: Weight) -> Motion:
    """Return the render under the shift of the whole picture that brings it closest."""
    return _fit_motion(render, reference, weight, 2)


def fit_homography(render: Picture, reference: Picture, weight: Weight) -> Motion:
    """Return the render under the homography that brings it closest: a turn, a plane's motion, a zoom."""
    return _fit_motion(render, reference, weight, 8)


def fit_local_motion(render: Picture, reference: Picture, weight: Weight) -> tuple[Picture, float]:
    """Return the render with each place moved to where its surroundings fit, and the mean motion in px.

    Surroundings are Gaussian windows (:data:`LOCAL_SIGMA_PX`), so that the motion is smooth; it is found by
    the steps of Lucas and Kanade ("An Iterative Image Registration Technique with an Application to Stereo
    Vision", IJCAI 1981) and is at most :data:`MAX_LOCAL_PX`.
    """
    grid = np.indices(weight.shape, np.float64)
    flow = np.zeros_like(grid)
    best, found, least = render.copy(), flow, _error(render, reference, weight)
    splines = [spline_filter(render[..., c].astype(np.float64), mode="nearest") for c in range(3)]
    for _ in range(LOCAL_STEPS):
        moved = _look_up(splines, grid + flow)
        a, b, c, p, q = (np.zeros(weight.shape) for _ in range(5))
        for channel in range(3):
            down, across = np.gradient(moved[..., channel])
            rest = reference[..., channel] - moved[..., channel]
            a, b, c = a + weight * down**2, b + weight * down * across, c + weight * across**2
            p, q = p + weight * down * rest, q + weight * across * rest
        a, b, c, p, q = (gaussian_filter(x, LOCAL_SIGMA_PX, mode="nearest") for x in (a, b, c, p, q))
        held = 0.02 * float((a + c).mean()) + 1e-9
        a, c = a + held, c + held
        determinant = a * c - b * b
        step = np.stack([(c * p - b * q) / determinant, (a * q - b * p) / determinant])
        flow = np.clip(flow + np.clip(step, -1, 1), -MAX_LOCAL_PX, MAX_LOCAL_PX)
        picture = np.clip(_look_up(splines, grid + flow), 0, 1).astype(np.float32)
        error = _error(picture, reference, weight)
        if error < least:
            best, found, least = picture, flow, error
    moved_px = float(np.average(np.hypot(*found), weights=weight)) if weight.sum() > 0 else 0.0
    return best, moved_px


def _fit_motion(render: Picture, reference: Picture, weight: Weight, numbers: int) -> Motion:
    """Take Gauss-Newton steps of a shift (2 numbers) or homography (8) while the error falls."""
    height, width = weight.shape
    unit = max(height, width) / 2
    y, x = np.indices(weight.shape, np.float64)
    x, y = (x - (width - 1) / 2) / unit, (y - (height - 1) / 2) / unit
    splines = [spline_filter(render[..., c].astype(np.float64), mode="nearest") for c in range(3)]
    matrix, damping = np.eye(3), 1e-6
    best, least = render.copy(), _error(render, reference, weight)
    now = render.astype(np.float64)
    for _ in range(MAX_STEPS):
        # x' = (x + a + c x + d y) / (1 + g x + h y), about the picture as it is moved now
        fields = [(one, zero) for one, zero in ((np.ones_like(x), 0.0),)] + [(0.0, np.ones_like(x))]
        if numbers == 8:
            fields += [(x, 0.0), (y, 0.0), (0.0, x), (0.0, y), (-x * x, -x * y), (-x * y, -y * y)]
        curvature, downhill = np.zeros((numbers, numbers)), np.zeros(numbers)
        for channel in range(3):
            down, across = np.gradient(now[..., channel])
            slopes = np.stack([unit * (u * across + v * down) for u, v in fields]).reshape(numbers, -1)
            weighted = slopes * weight.reshape(-1)
            curvature += weighted @ slopes.T
            downhill += weighted @ (reference[..., channel] - now[..., channel]).reshape(-1)
        held = np.diag(curvature.diagonal() * damping + 1e-9)
        step = np.linalg.solve(curvature + held, downhill)
        a, b, c, d, e, f, g, h = [*step, *np.zeros(8 - numbers)]
        # composed: first the step about the moved picture, then the motion so far
        tried = matrix @ np.array([[1 + c, d, a], [e, 1 + f, b], [g, h, 1]])
        tried /= tried[2, 2]
        places = _apply(tried, x, y)
        rows, columns = places[1] * unit + (height - 1) / 2, places[0] * unit + (width - 1) / 2
        picture = _look_up(splines, np.stack([rows, columns]))
        error = _error(np.clip(picture, 0, 1), reference, weight)
        if error >= least:
            if damping > 1:
                break
            damping = max(damping * 100, 1e-3)
            continue
        moved = unit * float(np.abs(tried - matrix).max())
        matrix, now, least, damping = tried, picture, error, damping / 10
        best = np.clip(picture, 0, 1).astype(np.float32)
        if moved < ENOUGH_PX:
            break
    corners_x = np.array([-1, 1, -1, 1]) * (width - 1) / 2 / unit
    corners_y = np.array([-1, -1, 1, 1]) * (height - 1) / 2 / unit
    to_x, to_y = _apply(matrix, corners_x, corners_y)
    corner = unit * float(np.hypot(to_x - corners_x, to_y - corners_y).max())
    middle_x, middle_y = _apply(matrix, np.zeros(1), np.zeros(1))
    return Motion(best, matrix, (unit * float(middle_x[0]), unit * float(middle_y[0])), corner)


def _apply(
    matrix: Float64[np.ndarray, "3 3"], x: Float64[np.ndarray, "*s"], y: Float64[np.ndarray, "*s"]
) -> tuple[Float64[np.ndarray, "*s"], Float64[np.ndarray, "*s"]]:
    depth = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
    return (
        (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / depth,
        (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / depth,
    )


def _look_up(splines: list[np.ndarray], places: Float64[np.ndarray, "2 h w"]) -> Float64[np.ndarray, "h w 3"]:
    """Return the picture whose cubic B-spline coefficients are given, at rows and columns."""
    return np.stack(
        [map_coordinates(spline, places, prefilter=False, mode="nearest") for spline in splines], axis=-1
    )


def _error(picture: np.ndarray, reference: Picture, weight: Weight) -> float:
    squared = np.square(np.asarray(picture, np.float64) - reference).mean(axis=-1)
    return float((squared * weight).sum())


def _hat_functions(length: int, knots: int) -> Float64[np.ndarray, "n k"]:
    """Return, for each pixel of a line, the weights of knots that lie evenly from its first to its last."""
    places = np.linspace(0, knots - 1, length)[:, None]
    return np.maximum(0.0, 1.0 - np.abs(places - np.arange(knots)))
