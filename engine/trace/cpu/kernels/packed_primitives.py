"""Packing of flat Gaussians into the tracer's primitives and bounding boxes."""

import math

import numpy as np
from jaxtyping import Bool, Float32, Int32

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.trace.cpu.kernels.kernel_args import GaussianParameters
from octasplat.engine.trace.cpu.kernels.octagon_hit import (
    AXIS_U,
    AXIS_V,
    COS_22,
    INNER_RADIUS,
    MEAN,
    NORMAL,
    OPACITY,
)


@device_function(_nrt=False, error_model="numpy")
def rotation_columns(
    q0: float, q1: float, q2: float, q3: float
) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
    """Return columns r1, r2, r3 of the rotation of a quaternion (w, x, y, z) of any length, float64."""
    scale = 1.0 / math.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    w, x, y, z = q0 * scale, q1 * scale, q2 * scale, q3 * scale
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


@device_function(_nrt=False, error_model="numpy")
def gaussian_axes(
    quats: Float32[np.ndarray, "n 4"], i: int
) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
    """Return r1, r2 and r3 of Gaussian ``i`` in float64: its normal and the axes of its ellipse."""
    return rotation_columns(
        np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    )


@device_function(_nrt=False, error_model="numpy")
def opacity_and_radius(logit: float, q: float) -> tuple[float, float]:
    """Return the opacity, and the octagon's corner radius in standard deviations."""
    # without overflow at either end
    part = math.exp(-abs(logit))
    opacity = (1.0 if logit > 0 else part) / (1.0 + part)
    # alpha = exp(-q / 2) at a corner, so that r^2 = q + 2 ln a
    return opacity, math.sqrt(max(0.0, q + 2.0 * math.log(opacity)))


@device_function(_nrt=False, error_model="numpy")
def ellipse_semi_axes(
    i: int,
    parameters: GaussianParameters,
    q: float,
) -> tuple[float, float, tuple[float, float, float], tuple[float, float, float]]:
    """Return corner radii in world units along r2 and r3, and those axes."""
    log_scales = parameters.log_scales
    _r1, r2, r3 = gaussian_axes(parameters.quats, i)
    _opacity, radius = opacity_and_radius(np.float64(parameters.logits[i]), q)
    s2, s3 = math.exp(np.float64(log_scales[i, 0])), math.exp(np.float64(log_scales[i, 1]))
    return radius * s2, radius * s3, r2, r3


@device_function(_nrt=False, error_model="numpy")
def pack_primitive(
    primitives: Float32[np.ndarray, "n 16"],
    i: int,
    parameters: GaussianParameters,
    q: float,
) -> None:
    """Pack one Gaussian into a row of ``primitives``."""
    means, log_scales = parameters.means, parameters.log_scales
    r1, r2, r3 = gaussian_axes(parameters.quats, i)
    per_s2, per_s3 = math.exp(-np.float64(log_scales[i, 0])), math.exp(-np.float64(log_scales[i, 1]))
    opacity, radius = opacity_and_radius(np.float64(parameters.logits[i]), q)
    for axis in range(3):
        primitives[i, MEAN + axis] = means[i, axis]
        primitives[i, NORMAL + axis] = r1[axis]
        # r2 / s2 and r3 / s3: a dot product with them is in standard deviations
        primitives[i, AXIS_U + axis] = r2[axis] * per_s2
        primitives[i, AXIS_V + axis] = r3[axis] * per_s3
    # A Gaussian without an octagon must not be hit even through its centre.
    primitives[i, INNER_RADIUS] = radius * COS_22 if radius > 0.0 else -1.0
    primitives[i, OPACITY] = opacity


@kernel(_nrt=False, error_model="numpy")
def pack_primitives(
    first: int,
    last: int,
    primitives: Float32[np.ndarray, "n 16"],
    parameters: GaussianParameters,
    q: float,
) -> None:
    """Pack the Gaussians ``first`` to ``last`` (exclusive) into rows of ``primitives``."""
    for i in range(first, last):
        pack_primitive(primitives, i, parameters, q)


@device_function(_nrt=False, error_model="numpy")
def write_box(
    box: Float32[np.ndarray, "6"],
    i: int,
    parameters: GaussianParameters,
    q: float,
    padding: float,
) -> None:
    """Write box of one octagon's ellipse enlarged by the fraction ``padding`` of its size.

    A Gaussian without an octagon gets a box turned inside out, which Embree leaves out of its hierarchy.
    """
    a, b, r2, r3 = ellipse_semi_axes(i, parameters, q)
    reach = padding * max(a, b)
    for axis in range(3):
        half = math.sqrt((a * r2[axis]) ** 2 + (b * r3[axis]) ** 2)  # half-width of an ellipse's box
        centre = np.float64(parameters.means[i, axis])
        # Room for float32 rounding in the box test, and for changes to come.
        half += reach + 4e-6 * (abs(centre) + half)
        if a <= 0.0 or not math.isfinite(half):
            box[axis], box[3 + axis] = np.inf, -np.inf
        else:
            box[axis], box[3 + axis] = centre - half, centre + half


@kernel(_nrt=False, error_model="numpy")
def write_boxes(
    first: int,
    last: int,
    boxes: Float32[np.ndarray, "n 6"],
    parameters: GaussianParameters,
    q: float,
    padding: float,
) -> None:
    """Write boxes of all octagons, see :func:`write_box`."""
    for i in range(first, last):
        write_box(boxes[i], i, parameters, q, padding)


@kernel(error_model="numpy")
def refit_outgrown_boxes(
    first: int,
    last: int,
    outgrown: Bool[np.ndarray, " u"],
    boxes: Float32[np.ndarray, "n 6"],
    ids: Int32[np.ndarray, " u"],
    parameters: GaussianParameters,
    q: float,
    padding: float,
) -> None:
    """Enlarge the boxes of those ``ids`` that have left theirs, and mark them in ``outgrown``.

    The new box is larger by ``padding`` and by four times the overhang, so that a Gaussian that keeps moving
    as fast does not need the next one at once.
    """
    for k in range(first, last):
        i = ids[k]
        now = np.empty(6, np.float32)
        write_box(now, i, parameters, q, 0.0)  # without padding: what is needed now
        out = np.float32(0.0)
        for axis in range(3):
            out = max(out, boxes[i, axis] - now[axis], now[3 + axis] - boxes[i, 3 + axis])
        if out > 0.0 and now[0] <= now[3]:  # not for a vanished octagon, whose box is inside out
            outgrown[k] = True
            write_box(boxes[i], i, parameters, q, padding)
            if out < np.inf:  # infinite where the old box was inside out
                for axis in range(3):
                    boxes[i, axis] -= 4 * out
                    boxes[i, 3 + axis] += 4 * out


@kernel(_nrt=False, error_model="numpy")
def repack_primitives(
    first: int,
    last: int,
    primitives: Float32[np.ndarray, "n 16"],
    ids: Int32[np.ndarray, " u"],
    parameters: GaussianParameters,
    q: float,
) -> None:
    """Write records of the Gaussians ``ids`` from their changed parameters."""
    for k in range(first, last):
        pack_primitive(primitives, ids[k], parameters, q)
