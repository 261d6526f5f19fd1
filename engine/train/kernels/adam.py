"""Adam on the Gaussians that were hit, all parameter groups in one pass.

"Adam: A Method for Stochastic Optimization" (Kingma and Ba 2015), with a step count for each Gaussian.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.trace.kernels.native import Address, njit_no_refcount, prefetch_bytes
from octasplat.engine.train.kernels.adam_lanes import LANES, step_few, step_lanes

GEOMETRY = 3 + 4 + 2 + 1
"""Columns of mean, quaternion, scales and opacity."""
CHUNK = 512
"""Gaussians that a thread takes at a time."""
AHEAD = 8
"""Gaussians between asking for their moments and harmonics and taking their step: rows of those that were hit
are too far apart for the processor to foresee.
"""
LEAST_SHARE = 1e-3
"""Numbers between 0 and 1 stay this far from both, so that they can come back."""


class AdamMoments(NamedTuple):
    """First and second moments of ``c`` columns of parameters, and what they decay by."""

    first: Float32[np.ndarray, "n c"]
    second: Float32[np.ndarray, "n c"]
    beta1: float
    beta2: float
    epsilon: float


class ParameterArrays(NamedTuple):
    """The trained parameters of the Gaussians."""

    means: Float32[np.ndarray, "n 3"]
    quats: Float32[np.ndarray, "n 4"]
    log_scales: Float32[np.ndarray, "n 2"]
    logits: Float32[np.ndarray, " n"]
    sh: Float32[np.ndarray, "n k 3"]


class ParameterGradients(NamedTuple):
    """Their gradients, a row for each Gaussian that was hit."""

    means: Float32[np.ndarray, "u 3"]
    quats: Float32[np.ndarray, "u 4"]
    log_scales: Float32[np.ndarray, "u 2"]
    logits: Float32[np.ndarray, " u"]
    sh: Float32[np.ndarray, "u k 3"]


class StepRates(NamedTuple):
    """How far a step goes.

    Attributes:
        mean: in world units or, where ``mean_by_size``, in units of the Gaussian's size: the geometric mean
            of its two scales.
        mean_by_size: see ``mean``.
        own_axes: means and quaternions are stepped along and around the Gaussian's normal and the two axes in
            its plane, each with moments of its own; the first column of the quaternion's is then unused.
        quat: of the quaternion.
        log_scale: of the logarithms of the scales.
        opacity: of the logit of the opacity.
        sh: of the harmonics' coefficients, one after the other, in whole vectors of ``LANES``.
    """

    mean: float
    mean_by_size: bool
    own_axes: bool
    quat: float
    log_scale: float
    opacity: float
    sh: Float32[np.ndarray, " c"]


class Regularization(NamedTuple):
    """Weights of the regularisers of opacity and scale, and the limits of the log scales."""

    opacity_weight: float
    scale_weight: float
    min_log_scale: float
    max_log_scale: float


class BiasCorrection(NamedTuple):
    """Each Gaussian has its own step count for the bias correction.

    Attributes:
        steps: of each Gaussian so far.
        powers: of both betas, for as many steps as any has taken and one more.
        corrections: receives what both moments are multiplied by.
    """

    steps: Int32[np.ndarray, " n"]
    powers: Float64[np.ndarray, "2 s"]
    corrections: Float64[np.ndarray, "u 2"]


class AdamStep(NamedTuple):
    """One step for the Gaussians ``ids``.

    ``regular`` adds the gradients of the regularisers. ``mean_steps`` receives each mean's step, world units.
    """

    ids: Int32[np.ndarray, " u"]
    bias: BiasCorrection
    moments: AdamMoments
    gaussians: ParameterArrays
    gradients: ParameterGradients
    rates: StepRates
    regular: Regularization
    mean_steps: Float32[np.ndarray, "u 3"]


@device_function()
def _update(
    value: float,
    gradient: float,
    moments: AdamMoments,
    row: int,
    column: int,
    rate: float,
    correction1: float,
    correction2: float,
) -> float:
    first, second, beta1, beta2, epsilon = moments
    m = beta1 * np.float64(first[row, column]) + (1.0 - beta1) * gradient  # m = beta1 m + (1 - beta1) g
    # v = beta2 v + (1 - beta2) g^2
    v = beta2 * np.float64(second[row, column]) + (1.0 - beta2) * gradient * gradient
    first[row, column] = m
    second[row, column] = v
    return value - rate * (m * correction1) / (math.sqrt(v * correction2) + epsilon)


@njit_no_refcount(fastmath={"contract"})
def own_axes_of(i: int, quats: Float32[np.ndarray, "n 4"], room: Float32[np.ndarray, "3 16"]) -> None:
    """Write the axes of Gaussian ``i`` as rows of ``room``: the normal and the two in its plane."""
    w, x, y, z = (
        np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3]),
    )  # fmt: skip
    s = 2.0 / (w * w + x * x + y * y + z * z)
    room[0, 0], room[0, 1], room[0, 2] = 1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)
    room[1, 0], room[1, 1], room[1, 2] = s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x)
    room[2, 0], room[2, 1], room[2, 2] = s * (x * z + w * y), s * (y * z - w * x), 1.0 - s * (x * x + y * y)


@njit_no_refcount(fastmath={"contract"})
def own_axes_gradient(
    k: int,
    i: int,
    quats: Float32[np.ndarray, "n 4"],
    g_quats: Float32[np.ndarray, "u 4"],
    out: Float32[np.ndarray, "16"],
) -> None:
    """Write the gradient of Gaussian ``i`` with respect to rotations about its own axes.

    That is by d, where its quaternion is multiplied by (1, d).
    """
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    # the vector part of conj(q) times the gradient
    a, b, c, d = g_quats[k, 0], g_quats[k, 1], g_quats[k, 2], g_quats[k, 3]
    out[3] = 0.0
    out[4] = -a * x + b * w + c * z - d * y
    out[5] = -a * y - b * z + c * w + d * x
    out[6] = -a * z + b * y - c * x + d * w


@njit_no_refcount(fastmath={"contract"})
def turn(i: int, quats: Float32[np.ndarray, "n 4"], by: Float32[np.ndarray, "16"]) -> None:
    """Replace the quaternion of Gaussian ``i`` by that times (1, ``by[4:7]``), of length 1."""
    w, x, y, z = (
        np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3]),
    )  # fmt: skip
    a, b, c = np.float64(by[4]), np.float64(by[5]), np.float64(by[6])
    # both lengths at once: of the quaternion and of (1, d)
    share = 1.0 / math.sqrt((w * w + x * x + y * y + z * z) * (1.0 + a * a + b * b + c * c))
    quats[i, 0] = (w - x * a - y * b - z * c) * share
    quats[i, 1] = (x + w * a + y * c - z * b) * share
    quats[i, 2] = (y + w * b + z * a - x * c) * share
    quats[i, 3] = (z + w * c + x * b - y * a) * share


@njit_no_refcount(fastmath={"contract"})
def step_sh(
    k: int,
    i: int,
    moments: AdamMoments,
    sh: Float32[np.ndarray, "n k 3"],
    g_sh: Float32[np.ndarray, "u k 3"],
    rates_sh: Float32[np.ndarray, " c"],
    few_at: Address,
    numbers: tuple[float, ...],
) -> None:
    """Step the harmonics of Gaussian ``i``, row ``k`` of the gradients; ``few_at`` is room for 64 float32."""
    first_at = moments.first.ctypes.data + i * moments.first.shape[1] * 4
    second_at = moments.second.ctypes.data + i * moments.second.shape[1] * 4
    columns = sh.shape[1] * 3
    for column in range(0, columns, LANES):
        sh_at = sh.ctypes.data + (i * columns + column) * 4
        g_sh_at = g_sh.ctypes.data + (k * columns + column) * 4
        rates_at = rates_sh.ctypes.data + column * 4
        sh_first_at = first_at + (GEOMETRY + column) * 4
        sh_second_at = second_at + (GEOMETRY + column) * 4
        columns_left = columns - column
        if columns_left >= LANES:
            step_lanes(sh_at, g_sh_at, rates_at, sh_first_at, sh_second_at, numbers)
        else:
            step_few(sh_at, g_sh_at, rates_at, sh_first_at, sh_second_at, columns_left, few_at, numbers)


@njit_no_refcount(fastmath={"contract"})
def step_gaussian(
    k: int,
    i: int,
    room: Float32[np.ndarray, "10 16"],
    step: AdamStep,
    numbers: tuple[float, ...],
) -> None:
    """Take one step of Gaussian ``i``, row ``k`` of the gradients."""
    moments, rates, regular, mean_steps = step.moments, step.rates, step.regular, step.mean_steps
    means, quats, log_scales, logits, sh = step.gaussians
    g_means, g_quats, g_log_scales, g_logits, g_sh = step.gradients
    # --- values, gradients and rates of the geometry, a row each ---
    values, g_values, value_rates, axes = room[0], room[1], room[2], room[3:6]
    few_at = room[6:].ctypes.data
    # scales before the step: the regularizer and the unit of the mean's step use them
    scale_0, scale_1 = math.exp(np.float64(log_scales[i, 0])), math.exp(np.float64(log_scales[i, 1]))
    rate = rates.mean
    if rates.mean_by_size:
        rate *= math.sqrt(scale_0 * scale_1)
    for axis in range(3):
        values[axis], g_values[axis], value_rates[axis] = 0.0, g_means[k, axis], rate  # the step alone
    for axis in range(4):
        values[3 + axis], g_values[3 + axis], value_rates[3 + axis] = (
            quats[i, axis], g_quats[k, axis], rates.quat,
        )  # fmt: skip
    for axis in range(2):
        values[7 + axis], value_rates[7 + axis] = log_scales[i, axis], rates.log_scale
    g_values[7] = g_log_scales[k, 0] + regular.scale_weight * scale_0
    g_values[8] = g_log_scales[k, 1] + regular.scale_weight * scale_1
    if rates.own_axes:
        own_axes_of(i, quats, axes)
        for axis in range(3):
            g_values[axis] = (
                axes[axis, 0] * g_means[k, 0] + axes[axis, 1] * g_means[k, 1] + axes[axis, 2] * g_means[k, 2]
            )
            values[4 + axis] = 0.0
        own_axes_gradient(k, i, quats, g_quats, g_values)
    opacity = 0.0
    if regular.opacity_weight != 0.0:
        opacity = 1.0 / (1.0 + math.exp(-np.float64(logits[i])))
    values[9], value_rates[9] = logits[i], rates.opacity
    g_values[9] = g_logits[k] + regular.opacity_weight * opacity * (1.0 - opacity)  # d opacity / d logit
    first_at = moments.first.ctypes.data + i * moments.first.shape[1] * 4
    second_at = moments.second.ctypes.data + i * moments.second.shape[1] * 4
    values_at, g_values_at, value_rates_at = values.ctypes.data, g_values.ctypes.data, value_rates.ctypes.data
    step_few(values_at, g_values_at, value_rates_at, first_at, second_at, GEOMETRY, few_at, numbers)
    step_sh(k, i, moments, sh, g_sh, rates.sh, few_at, numbers)
    # --- the new parameters ---
    if rates.own_axes:
        turn(i, quats, values)
        for axis in range(3):
            mean_steps[k, axis] = (
                axes[0, axis] * values[0] + axes[1, axis] * values[1] + axes[2, axis] * values[2]
            )
    else:
        for axis in range(4):
            quats[i, axis] = values[3 + axis]
        for axis in range(3):
            mean_steps[k, axis] = values[axis]
    for axis in range(3):
        means[i, axis] += mean_steps[k, axis]
    for axis in range(2):
        log_scales[i, axis] = min(
            max(np.float64(values[7 + axis]), regular.min_log_scale), regular.max_log_scale
        )
    logits[i] = values[9]


@njit_no_refcount(fastmath={"contract"})
def step_chunk(begin: int, end: int, room: Float32[np.ndarray, "10 16"], step: AdamStep) -> None:
    """Take one step of the Gaussians of rows ``begin`` to ``end``."""
    ids, sh = step.ids, step.gaussians.sh
    first, second, beta1, beta2, epsilon = step.moments
    steps, powers, corrections = step.bias
    moments_bytes, sh_bytes = first.shape[1] * 4, sh.shape[1] * 12
    for k in range(begin, end):
        if k + AHEAD < end:
            ahead = ids[k + AHEAD]
            prefetch_bytes(first.ctypes.data + ahead * moments_bytes, moments_bytes)
            prefetch_bytes(second.ctypes.data + ahead * moments_bytes, moments_bytes)
            prefetch_bytes(sh.ctypes.data + ahead * sh_bytes, sh_bytes)
        i = ids[k]
        steps[i] += 1
        c1, c2 = 1.0 / (1.0 - powers[0, steps[i]]), 1.0 / (1.0 - powers[1, steps[i]])
        corrections[k, 0], corrections[k, 1] = c1, c2
        numbers = (
            np.float32(c1), np.float32(c2), np.float32(beta1), np.float32(beta2),
            np.float32(1.0 - beta1), np.float32(1.0 - beta2), np.float32(epsilon),
        )  # fmt: skip
        step_gaussian(k, i, room, step, numbers)


@kernel()
def adam_step(
    first_chunk: int,
    last_chunk: int,
    step: AdamStep,
) -> None:
    """Take a step for the Gaussians of some chunks of :data:`CHUNK` each."""
    count = len(step.ids)
    for chunk in range(first_chunk, last_chunk):
        room = np.zeros((10, LANES), np.float32)
        step_chunk(chunk * CHUNK, min(count, (chunk + 1) * CHUNK), room, step)


@kernel()
def adam_shares(
    first_row: int,
    last_row: int,
    ids: Int32[np.ndarray, " u"],
    corrections: Float64[np.ndarray, "u 2"],
    moments: AdamMoments,
    column: int,
    values: Float32[np.ndarray, "n w"],
    g_values: Float32[np.ndarray, "u w"],
    rate: float,
) -> None:
    """Take one step for numbers in (0, 1) of the Gaussians ``ids``, taken by their logits.

    Their moments begin at ``column``; ``corrections`` are those of :func:`adam_step`. A ``rate`` of 0 changes
    nothing.
    """
    for k in range(first_row, last_row):
        i = ids[k]
        c1, c2 = corrections[k, 0], corrections[k, 1]
        for place in range(values.shape[1]):
            # a logit of exactly 0 or 1 would be infinite
            value = min(max(np.float64(values[i, place]), LEAST_SHARE), 1.0 - LEAST_SHARE)
            gradient = np.float64(g_values[k, place]) * value * (1.0 - value)  # by the logit
            logit = _update(
                math.log(value / (1.0 - value)), gradient, moments, i, column + place, rate, c1, c2
            )
            value = 1.0 / (1.0 + math.exp(-logit))
            values[i, place] = min(max(value, LEAST_SHARE), 1.0 - LEAST_SHARE)
