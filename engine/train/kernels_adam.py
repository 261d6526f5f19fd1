"""Adam on the Gaussians that were hit, all parameter groups in one pass."""

import math

import numpy as np
from numba import njit, prange

LEAST_SHARE = 1e-3
"""Numbers between 0 and 1 stay this far from both, so that they can come back."""


@njit
def _update(
    value, gradient, first, second, row, column, rate, correction1, correction2, beta1, beta2, epsilon
):
    m = beta1 * np.float64(first[row, column]) + (1.0 - beta1) * gradient
    v = beta2 * np.float64(second[row, column]) + (1.0 - beta2) * gradient * gradient
    first[row, column] = m
    second[row, column] = v
    return value - rate * (m * correction1) / (math.sqrt(v * correction2) + epsilon)


@njit(cache=True, parallel=True)
def adam_step(
    ids, steps, first, second,
    means, quats, log_scales, logits, sh,
    g_means, g_quats, g_log_scales, g_logits, g_sh,
    rate_mean, mean_by_size, rate_quat, rate_log_scale, rate_opacity, rate_sh0, rate_sh_rest,
    opacity_weight, scale_weight, min_log_scale, max_log_scale,
    beta1, beta2, epsilon, mean_steps, corrections,
):  # fmt: skip
    """One step for the Gaussians ``ids``; each has its own step count for the bias correction.

    ``rate_mean`` is in world units or, where ``mean_by_size``, in units of the Gaussian's size: the geometric
    mean of its two scales.

    ``opacity_weight`` and ``scale_weight`` add the gradients of their regularisers. ``mean_steps`` receives
    each mean's step, world units, and ``corrections`` what both moments are multiplied by.
    """
    basis_count = sh.shape[1]
    for k in prange(len(ids)):
        i = ids[k]
        steps[i] += 1
        c1 = 1.0 / (1.0 - beta1 ** steps[i])
        c2 = 1.0 / (1.0 - beta2 ** steps[i])
        corrections[k, 0], corrections[k, 1] = c1, c2
        column = 0
        rate = rate_mean
        if mean_by_size:
            rate *= math.exp(0.5 * (np.float64(log_scales[i, 0]) + np.float64(log_scales[i, 1])))
        for axis in range(3):
            old = np.float64(means[i, axis])
            new = _update(
                old, np.float64(g_means[k, axis]),
                first, second, i, column, rate, c1, c2, beta1, beta2, epsilon,
            )  # fmt: skip
            means[i, axis] = new
            mean_steps[k, axis] = new - old
            column += 1
        for axis in range(4):
            quats[i, axis] = _update(
                np.float64(quats[i, axis]), np.float64(g_quats[k, axis]),
                first, second, i, column, rate_quat, c1, c2, beta1, beta2, epsilon,
            )  # fmt: skip
            column += 1
        for axis in range(2):
            value = np.float64(log_scales[i, axis])
            value = _update(
                value, np.float64(g_log_scales[k, axis]) + scale_weight * math.exp(value),
                first, second, i, column, rate_log_scale, c1, c2, beta1, beta2, epsilon,
            )  # fmt: skip
            log_scales[i, axis] = min(max(value, min_log_scale), max_log_scale)
            column += 1
        value = np.float64(logits[i])
        opacity = 1.0 / (1.0 + math.exp(-value))
        logits[i] = _update(
            value, np.float64(g_logits[k]) + opacity_weight * opacity * (1.0 - opacity),
            first, second, i, column, rate_opacity, c1, c2, beta1, beta2, epsilon,
        )  # fmt: skip
        column += 1
        for j in range(basis_count):
            rate = rate_sh0 if j == 0 else rate_sh_rest
            for channel in range(3):
                sh[i, j, channel] = _update(
                    np.float64(sh[i, j, channel]), np.float64(g_sh[k, j, channel]),
                    first, second, i, column, rate, c1, c2, beta1, beta2, epsilon,
                )  # fmt: skip
                column += 1


@njit(cache=True, parallel=True)
def adam_shares(ids, corrections, first, second, column, values, g_values, rate, beta1, beta2, epsilon):
    """One step for numbers in (0, 1) of the Gaussians ``ids``, taken by their logits.

    Their moments begin at ``column``; ``corrections`` are those of :func:`adam_step`. A ``rate`` of 0 changes
    nothing.
    """
    for k in prange(len(ids)):
        i = ids[k]
        c1, c2 = corrections[k, 0], corrections[k, 1]
        for place in range(values.shape[1]):
            value = min(max(np.float64(values[i, place]), LEAST_SHARE), 1.0 - LEAST_SHARE)
            gradient = np.float64(g_values[k, place]) * value * (1.0 - value)
            logit = _update(
                math.log(value / (1.0 - value)), gradient,
                first, second, i, column + place, rate, c1, c2, beta1, beta2, epsilon,
            )  # fmt: skip
            value = 1.0 / (1.0 + math.exp(-logit))
            values[i, place] = min(max(value, LEAST_SHARE), 1.0 - LEAST_SHARE)
