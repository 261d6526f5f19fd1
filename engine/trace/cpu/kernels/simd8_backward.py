"""Eight hits of a ray at a time backwards, as explicit vectors.

See :mod:`octasplat.engine.trace.cpu.kernels.simd8`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import llvmlite.ir as ir
from numba import types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.trace.cpu.kernels.simd_ops import (
    DOUBLE,
    FLOAT,
    I32,
    INT8,
    LONG8,
    element_address,
    first_lanes_mask,
    gather,
    keep_first_lanes,
    load,
    prefix_scan,
    shift_lanes,
    splat,
    store,
)
from octasplat.engine.trace.cpu.kernels.simd_vector import (
    DOUBLE8,
    FLOAT8,
    I64,
    LANES,
    Vector,
    VectorRows,
    broadcast,
)
from octasplat.engine.trace.kernels.native import Address, Intrinsic


@intrinsic
def transmittance_before8(
    typingctx: TypingContext, alphas: Address, count: int, transmittance: float, transmittance_before: Address
) -> Intrinsic:
    """Write the transmittance before each of ``count`` of eight hits with float32 ``alphas``.

    ``transmittance`` is that before the first. Returns that behind the last.
    """
    address, double = types.uintp, types.float64
    signature = double(address, types.int64, double, address)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        alphas_at, count, transmittance, transmittance_before_at = args
        alpha = keep_first_lanes(builder, VectorRows(builder, alphas_at, FLOAT8)[0].to_float64(), count)
        product = prefix_scan(builder, 1.0 - alpha, lambda a, b: a * b, 1.0)
        store(
            builder,
            (shift_lanes(builder, product, 1, 1.0) * broadcast(builder, transmittance)).value,
            transmittance_before_at,
        )
        return builder.fmul(
            builder.extract_element(product.value, ir.Constant(I32, LANES - 1)), transmittance
        )

    return signature, codegen


class Hits8(NamedTuple):
    """Addresses of eight hits: float32 alphas, u and v, float64 transmittance before each, int32 slots."""

    alphas: Address
    transmittance_before: Address
    slots: Address
    us: Address
    vs: Address


class HitGradients8(NamedTuple):
    """Addresses that gradients of hits go to: the rows of the slots, and eight float32 each of two kinds."""

    rows: Address
    weights: Address
    log_alpha_gradients: Address


@intrinsic
def backward_hits8(
    typingctx: TypingContext,
    hits: Hits8,
    weight_gradients: Address,
    slot_rgb: Address,
    count: int,
    gradient_behind: float,
    alpha_max: float,
    ray_gradients: Address,
    out: HitGradients8,
) -> Intrinsic:
    """Propagate gradients back through ``count`` of eight hits, into the rows of their Gaussians.

    Args:
        typingctx: numba's.
        hits: the hits.
        weight_gradients: dL by a weight of one of each hit, float64, but for what its color does to that.
        slot_rgb: float32 colors of the slots.
        count: how many of the eight there are.
        gradient_behind: dL by what lies behind the last.
        alpha_max: the alpha (float32) that was clamped and has no gradient.
        ray_gradients: eight float32 of the ray: 1, 0, its error, dL by its color, 0, 0.
        out: row s at ``rows`` is that of slot s, sixteen float32.

    Of each hit, with h = dL/d ln(alpha), adds to the first eight the moments h (1, u, v, u^2, u v, v^2,
    u (u^2 + v^2), v (u^2 + v^2)), and to the others its weight times the eight of the ray, but for the second
    of them, which counts. Writes weights and h, float32; returns dL by what lies behind the hit before.
    """
    address, double = types.uintp, types.float64
    signature = double(hits, address, address, types.int64, double, types.float32, address, out)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        hits, weight_gradients, slot_rgb, count, behind, alpha_max, ray_gradients, out = args
        alphas, transmittance_before, slots, us, vs = cgutils.unpack_tuple(builder, hits)
        rows, weights, log_alpha_gradients = cgutils.unpack_tuple(builder, out)
        valid = first_lanes_mask(builder, count)
        slot = builder.sext(load(builder, slots, INT8), LONG8)
        # lanes beyond the count gather from slot 0, which exists
        slot = builder.select(valid, slot, ir.Constant(LONG8, [0] * LANES))
        weight_gradient = VectorRows(builder, weight_gradients, DOUBLE8)[0]
        first_word = builder.mul(slot, ir.Constant(LONG8, [3] * LANES))
        for channel in range(3):
            word = builder.add(first_word, ir.Constant(LONG8, [channel] * LANES))
            color = builder.fpext(gather(builder, slot_rgb, word, FLOAT8), DOUBLE8)
            channel_at = builder.add(ray_gradients, ir.Constant(I64, (3 + channel) * 4))
            slope = builder.fpext(builder.load(builder.inttoptr(channel_at, FLOAT.as_pointer())), DOUBLE)
            weight_gradient = weight_gradient + Vector(builder, color) * broadcast(builder, slope)
        alpha = VectorRows(builder, alphas, FLOAT8)[0].to_float64()
        clamped = alpha >= broadcast(builder, builder.fpext(alpha_max, DOUBLE))
        alpha = keep_first_lanes(builder, alpha, count)
        transmittance_before = VectorRows(builder, transmittance_before, DOUBLE8)[0]
        weight = keep_first_lanes(builder, alpha * transmittance_before, count)
        weighted = keep_first_lanes(builder, weight * weight_gradient, count)
        # what lies behind each hit, within the eight
        sums = prefix_scan(builder, weighted, lambda a, b: a + b, 0.0, reverse=True)
        later = shift_lanes(builder, sums, -1, 0.0) + broadcast(builder, behind)
        h = (transmittance_before * weight_gradient - later / (1.0 - alpha)) * alpha  # dL/dalpha times alpha
        h = keep_first_lanes(builder, clamped.select(0.0, h), count)
        weight, h = builder.fptrunc(weight.value, FLOAT8), builder.fptrunc(h.value, FLOAT8)
        store(builder, weight, weights)
        store(builder, h, log_alpha_gradients)
        u, v = load(builder, us, FLOAT8), load(builder, vs, FLOAT8)
        _accumulate_moments(builder, h, u, v, weights, ray_gradients, slots, rows, count)
        first = builder.extract_element(sums.value, ir.Constant(I32, 0))
        return builder.fadd(first, behind)

    return signature, codegen


@intrinsic
def accumulate_row(typingctx: TypingContext, sums: Address, row: Address) -> Intrinsic:
    """Add a row of sixteen float32 to sixteen doubles."""
    signature = types.void(types.uintp, types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        total, added = VectorRows(builder, args[0], DOUBLE8), VectorRows(builder, args[1], FLOAT8)
        for half in range(2):
            total[half] = total[half] + added[half].to_float64()
        return context.get_dummy_value()

    return signature, codegen


def _accumulate_moments(
    builder: ir.IRBuilder,
    h: ir.Value,
    u: ir.Value,
    v: ir.Value,
    weights: ir.Value,
    ray_gradients: ir.Value,
    slots: ir.Value,
    rows: ir.Value,
    count: ir.Value,
) -> None:
    """Write the rows' part of :func:`backward_hits8`."""

    def times(a: ir.Value, b: ir.Value) -> ir.Value:
        return builder.fmul(a, b, flags=("contract",))

    def plus(a: ir.Value, b: ir.Value) -> ir.Value:
        return builder.fadd(a, b, flags=("contract",))

    # --- the first eight words: moments of h; the rows of all hits by a transposition in registers ---
    hu, hv, square = times(h, u), times(h, v), plus(times(u, u), times(v, v))
    moments = (h, hu, hv, times(hu, u), times(hu, v), times(hv, v), times(hu, square), times(hv, square))
    turned = cgutils.alloca_once(builder, ir.ArrayType(FLOAT8, LANES))
    for k, row in enumerate(_transpose8(builder, moments)):
        builder.store(row, builder.gep(turned, [ir.Constant(I32, 0), ir.Constant(I32, k)]))
    ray = load(builder, ray_gradients, FLOAT8)
    counting = ir.Constant(FLOAT8, [0.0, 1.0, *[0.0] * 6])  # word 9, COUNT
    slots = builder.inttoptr(slots, I32.as_pointer())
    weights = builder.inttoptr(weights, FLOAT.as_pointer())
    with cgutils.for_range(builder, count) as loop:
        k = loop.index
        slot = builder.sext(builder.load(builder.gep(slots, [k])), I64)
        at = element_address(builder, rows, slot, 64)
        moment = builder.load(builder.gep(turned, [ir.Constant(I32, 0), k]))
        store(builder, builder.fadd(load(builder, at, FLOAT8), moment), at)
        at = builder.add(at, ir.Constant(I64, 32))
        weight = splat(builder, builder.load(builder.gep(weights, [k])), FLOAT)
        added = builder.fadd(plus(times(ray, weight), load(builder, at, FLOAT8)), counting)
        store(builder, added, at)


def _transpose8(builder: ir.IRBuilder, rows: Sequence[ir.Value]) -> list[ir.Value]:
    """Transpose eight vectors of eight float32."""

    def mixed(a: ir.Value, b: ir.Value, order: list[int]) -> ir.Value:
        return builder.shuffle_vector(a, b, ir.Constant(INT8, order))

    pairs = [
        mixed(rows[k], rows[k + 1], order)
        for k in range(0, LANES, 2)
        for order in ([0, 8, 1, 9, 4, 12, 5, 13], [2, 10, 3, 11, 6, 14, 7, 15])
    ]
    fours = [
        mixed(pairs[k + half], pairs[k + 2 + half], order)
        for k in (0, 4)
        for half in (0, 1)
        for order in ([0, 1, 8, 9, 4, 5, 12, 13], [2, 3, 10, 11, 6, 7, 14, 15])
    ]
    return [
        mixed(fours[k], fours[k + 4], order)
        for order in ([0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15])
        for k in range(4)
    ]
