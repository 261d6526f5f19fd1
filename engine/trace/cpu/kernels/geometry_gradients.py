"""Gradients of a Gaussian's raw geometry from sums over its hits."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from octasplat.engine.trace.cpu.kernels.kernel_args import GaussianGradientArrays
from octasplat.engine.trace.cpu.kernels.octagon_hit import OPACITY
from octasplat.engine.trace.cpu.kernels.packed_primitives import gaussian_axes
from octasplat.engine.trace.kernels.native import njit_no_refcount


class GaussianMoments(NamedTuple):
    """Sums over a Gaussian's hits; with the hit at u, v standard deviations and tau = dL/dt / <d, r1>.

    ``n0`` to ``n2`` sum the gradient of the turned normal times the weight, ``m0`` to ``m2`` that by the mean
    through the direction in which its color is seen.
    """

    h: float
    hu: float
    hv: float
    huu: float
    huv: float
    hvv: float
    tau: float
    tau_u: float
    tau_v: float
    n0: float
    n1: float
    n2: float
    m0: float
    m1: float
    m2: float


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def write_geometry_gradients(
    segment: int,
    i: int,
    frame: tuple[
        tuple[float, float, float], tuple[float, float, float], tuple[float, float, float], float, float
    ],
    quats: Float32[np.ndarray, "n 4"],
    primitives: Float32[np.ndarray, "n 16"],
    moments: GaussianMoments,
    out: GaussianGradientArrays,
) -> None:
    """Write gradients of one Gaussian's raw geometry from its sums over rays.

    In the Gaussian's own frame, with u, v the hit in standard deviations, tau = dL/dt through the point
    over <d, r1>: dL/dm = S(h u)/s2 r2 + S(h v)/s3 r3 + S(tau) r1, dL/dln s = S(h u^2), S(h v^2), and the
    frame turns by the torque S r_i x dL/dr_i. ``frame`` are r1, r2, r3, s2 and s3.
    """
    q0, q1, q2, q3 = (
        np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    )  # fmt: skip
    r1, r2, r3, s2, s3 = frame
    inv_s2, inv_s3 = 1.0 / s2, 1.0 / s3
    # torque = r1 x G1 + r2 x G2 + r3 x G3, G1 = -(sums.tau_u s2 r2 + sums.tau_v s3 r3) + normal channel
    on_r3, on_r2 = -moments.tau_u * s2, moments.tau_v * s3
    on_r1 = -moments.huv * s3 * inv_s2 + moments.huv * s2 * inv_s3
    w0 = on_r1 * r1[0] + on_r2 * r2[0] + on_r3 * r3[0] + r1[1] * moments.n2 - r1[2] * moments.n1
    w1 = on_r1 * r1[1] + on_r2 * r2[1] + on_r3 * r3[1] + r1[2] * moments.n0 - r1[0] * moments.n2
    w2 = on_r1 * r1[2] + on_r2 * r2[2] + on_r3 * r3[2] + r1[0] * moments.n1 - r1[1] * moments.n0
    # dL/dq = 2 (0, w) q / |q|^2: the rotation depends on the direction of q only
    factor = 2.0 / (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    # w, x, y and z of the quaternion product (0, w) q
    out.quats[segment, 0] = factor * (-w0 * q1 - w1 * q2 - w2 * q3)
    out.quats[segment, 1] = factor * (w0 * q0 + w1 * q3 - w2 * q2)
    out.quats[segment, 2] = factor * (w1 * q0 + w2 * q1 - w0 * q3)
    out.quats[segment, 3] = factor * (w2 * q0 + w0 * q2 - w1 * q1)
    grad_view = moments.m0, moments.m1, moments.m2
    for axis in range(3):
        out.means[segment, axis] = (
            moments.hu * inv_s2 * r2[axis]
            + moments.hv * inv_s3 * r3[axis]
            + moments.tau * r1[axis]
            + grad_view[axis]
        )
    out.log_scales[segment, 0] = moments.huu
    out.log_scales[segment, 1] = moments.hvv
    # da/dlogit = a (1 - a), and h is by ln a
    out.logits[segment] = moments.h * (1.0 - np.float64(primitives[i, OPACITY]))


@njit_no_refcount(forceinline=True)
def gaussian_frame(
    i: int, quats: Float32[np.ndarray, "n 4"], log_scales: Float32[np.ndarray, "n 2"]
) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float], float, float]:
    """Return the normal, both tangents and the standard deviations along them of Gaussian ``i``, in float64.

    They are the columns of its rotation, normal first, and the two scales; its quaternion has w first.
    """
    normal, tangent_u, tangent_v = gaussian_axes(quats, i)
    scale_u, scale_v = math.exp(np.float64(log_scales[i, 0])), math.exp(np.float64(log_scales[i, 1]))
    return normal, tangent_u, tangent_v, scale_u, scale_v
