"""Eight hits of a ray at a time, as explicit vectors: where they are, how opaque, and what light is left.

Where a hit is and how opaque is found in float32, one register of AVX2 for eight; what light is left is
multiplied up in doubles. Addresses point to doubles, eight to a vector, unless said otherwise; stores may
write up to eight values where fewer count, so that arrays have room for eight more. No flag allows the
compiler to change a result.
"""

from collections.abc import Sequence
from typing import NamedTuple

import llvmlite.ir as ir
import numpy as np
from numba import types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.trace.cpu.kernels.simd_ops import (
    DOUBLE,
    I32,
    INT8,
    LONG8,
    MASK8,
    CompressedStore,
    element_address,
    first_lanes_mask,
    gather,
    keep_first_lanes,
    key_distances,
    key_indices,
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
    exp_float32,
)
from octasplat.engine.trace.kernels.native import Address, Intrinsic

N_X, A_X, B_X, N_0, INNER_RADIUS_ROW, ALPHA_0 = 0, 3, 6, 9, 10, 11
ROWS = 12
"""Rows of a block of eight candidates, float32: u (N.d) = A.d and v (N.d) = B.d, t (N.d) = n0.

N, A and B are along their packet's axis, e and f, where a ray is d = c (1, a, b) with small slopes a and b.
"""


class PacketRay(NamedTuple):
    """A ray in its packet's frame, float32: the axis plus ``a`` e plus ``b`` f, over ``per_axis``."""

    a: np.float32
    b: np.float32
    per_axis: np.float32
    t_min: np.float32
    t_max: np.float32


class HitBuffer(NamedTuple):
    """Hit buffer of a ray: addresses of its uint64 keys, float32 numbers and int32 candidates."""

    keys: Address
    exponents: Address
    opacities: Address
    us: Address
    vs: Address
    candidate_indices: Address


class HitTables(NamedTuple):
    """Addresses of the float32 u and v of a packet's hits, which keys point into."""

    us: Address
    vs: Address


class HitStore(NamedTuple):
    """Addresses of the arrays in which hits are kept for the backward pass, 32 bits a number."""

    alphas: Address
    distances: Address
    us: Address
    vs: Address
    slots: Address


@intrinsic
def intersect_block8(
    typingctx: TypingContext,
    block: Address,
    ray: PacketRay,
    first_candidate: int,
    hit_count: int,
    hits: HitBuffer,
) -> Intrinsic:
    """Test the eight candidates of a block, from ``first_candidate`` on; how many octagons the ray meets.

    The ray has the slopes ``a`` and ``b`` in its packet's frame and is ``per_axis`` times as long as its
    way along the axis. Of each octagon that it meets between the two distances writes from place
    ``hit_count`` on, without gaps: a key, the float32 distance in the upper half and the place in the lower
    (uint64); and as 32-bit words the exponent -(u^2 + v^2)/2, the opacity, u, v and the number of the
    candidate. A ray that makes a cosine below 1e-6 with the normal runs inside the plane and meets nothing.
    """
    signature = types.int64(types.uintp, ray, types.int64, types.int64, hits)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        block, ray, first, tail, hits = args
        a, b, per_axis, t_min, t_max = cgutils.unpack_tuple(builder, ray)
        keys, powers, opacities, us, vs, numbers = cgutils.unpack_tuple(builder, hits)
        rows = VectorRows(builder, block, FLOAT8)
        a, b, per_axis, t_min, t_max = (broadcast(builder, value) for value in (a, b, per_axis, t_min, t_max))

        def along(row: int) -> Vector:
            return rows[row + 2] * b + (rows[row + 1] * a + rows[row])

        slant = along(N_X)  # the cosine times per_axis, as (1, a, b) is longer than the ray
        inverse = 1.0 / slant
        u, v = along(A_X) * inverse, along(B_X) * inverse
        # edge normals of the octagon; the absolute values map all eight to two
        cos_22, sin_22 = 0.9238795325112867, 0.3826834323650898
        farthest = (abs(u) * cos_22 + abs(v) * sin_22).maximum(abs(u) * sin_22 + abs(v) * cos_22)
        t = rows[N_0] * inverse * per_axis
        met = (
            (farthest <= rows[INNER_RADIUS_ROW]) & (abs(slant) >= per_axis * 1e-6) & (t > t_min) & (t < t_max)
        )

        compressed = CompressedStore(context, builder, met.value)
        places = builder.add(splat(builder, tail, I64), ir.Constant(LONG8, list(range(LANES))))
        # distances beyond t_min are positive, so that their bits sort like the numbers
        distance = builder.zext(compressed.compress(builder.bitcast(t.value, INT8)), LONG8)
        key = builder.or_(builder.shl(distance, ir.Constant(LONG8, [32] * LANES)), places)
        store(builder, key, element_address(builder, keys, tail, 8))
        number = builder.add(
            splat(builder, builder.trunc(first, I32), I32), ir.Constant(INT8, list(range(LANES)))
        )
        power = (u * u + v * v) * -0.5
        for vector, array in ((power, powers), (rows[ALPHA_0], opacities), (u, us), (v, vs)):
            compressed.compress_store(vector.value, element_address(builder, array, tail, 4))
        compressed.compress_store(number, element_address(builder, numbers, tail, 4))
        return compressed.count()

    return signature, codegen


@intrinsic
def eval_alphas8(
    typingctx: TypingContext, exponents: Address, opacities: Address, first: int, alpha_max: float
) -> Intrinsic:
    """Evaluate eight alphas from exponents: opacity exp(power), at most the maximum; all float32.

    The exponential is right to a relative 1e-7 for |power| < 87.
    """
    signature = types.void(types.uintp, types.uintp, types.int64, types.float32)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        powers, opacities, place, alpha_max = args
        at = element_address(builder, powers, place, 4)
        opacity = VectorRows(builder, element_address(builder, opacities, place, 4), FLOAT8)[0]
        found = opacity * exp_float32(builder, VectorRows(builder, at, FLOAT8)[0])
        store(builder, found.minimum(broadcast(builder, alpha_max)).value, at)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def rank_sort(typingctx: TypingContext, keys: Address, count: int, sorted_keys: Address) -> Intrinsic:
    """Sort ``count`` different keys (uint64) in place: each goes behind as many as are smaller than it.

    That takes as many steps as pairs, but no branch that the processor could guess wrongly. Both arrays have
    room for eight more; ``sorted_keys`` is for the work. Tells whether the upper halves of some are the same.
    """
    signature = types.boolean(types.uintp, types.int64, types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        keys, count, sorted_keys = args
        zeros = ir.Constant(LONG8, [0] * LANES)
        last = builder.sub(count, ir.Constant(I64, 1))
        blocks = builder.add(builder.ashr(last, ir.Constant(I64, 3)), ir.Constant(I64, 1))
        words = builder.inttoptr(keys, I64.as_pointer())
        pointers = ir.VectorType(ir.IntType(8).as_pointer(), LANES)
        function_type = ir.FunctionType(ir.VoidType(), [LONG8, pointers, I32, MASK8])
        scatter = cgutils.get_or_insert_function(
            builder.module, function_type, "llvm.masked.scatter.v8i64.v8p0"
        )
        with cgutils.for_range(builder, blocks) as block:
            first = builder.mul(block.index, ir.Constant(I64, LANES))
            mine = load(builder, element_address(builder, keys, first, 8), LONG8)
            below = cgutils.alloca_once(builder, LONG8)
            builder.store(zeros, below)
            with cgutils.for_range(builder, count) as loop:
                other = splat(builder, builder.load(builder.gep(words, [loop.index])), I64)
                so_far = builder.load(below)
                more = builder.add(so_far, ir.Constant(LONG8, [1] * LANES))
                smaller = builder.icmp_unsigned("<", other, mine)
                builder.store(builder.select(smaller, more, so_far), below)
            # What is beyond the last goes behind it, so that no lane asks whether it may be stored.
            valid = first_lanes_mask(builder, builder.sub(count, first))
            beyond = builder.add(splat(builder, first, I64), ir.Constant(LONG8, list(range(LANES))))
            places = builder.select(valid, builder.load(below), beyond)
            places = builder.mul(places, ir.Constant(LONG8, [8] * LANES))
            where = builder.inttoptr(builder.add(places, splat(builder, sorted_keys, I64)), pointers)
            builder.call(scatter, [mine, where, ir.Constant(I32, 8), ir.Constant(MASK8, [1] * LANES)])
        same = cgutils.alloca_once(builder, MASK8)
        builder.store(ir.Constant(MASK8, [0] * LANES), same)
        with cgutils.for_range(builder, blocks) as block:
            first = builder.mul(block.index, ir.Constant(I64, LANES))
            at = element_address(builder, sorted_keys, first, 8)
            one = load(builder, at, LONG8)
            # One further on; what lies behind the last counts for nothing.
            next_one = load(builder, builder.add(at, ir.Constant(I64, 8)), LONG8)
            alike = builder.icmp_unsigned("<", builder.xor(one, next_one), ir.Constant(LONG8, [1 << 32] * 8))
            alike = builder.and_(alike, first_lanes_mask(builder, builder.sub(last, first)))
            builder.store(builder.or_(builder.load(same), alike), same)
            store(builder, one, element_address(builder, keys, first, 8))
        bits = builder.bitcast(builder.load(same), ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return signature, codegen


@intrinsic
def composite8(
    typingctx: TypingContext,
    keys: Address,
    max_count: int,
    safe_key: Address,
    alpha_table: Address,
    transmittance: float,
    min_transmittance: float,
    alphas: Address,
    weights: Address,
    transmittance_after: Address,
) -> Intrinsic:
    """Composite the next of a ray's sorted hits, eight at the most.

    ``transmittance`` is what is left before them. Counts those of the first ``max_count`` of the ``keys``
    that are below ``safe_key``. Writes their alphas, read from ``alpha_table`` at the places in the keys,
    to ``alphas`` (both float32), alpha T to ``weights``, and the transmittance behind each to
    ``transmittance_after``; what lies beyond them changes nothing. The result has the bits of those behind
    which it is below ``min_transmittance``; eight bits higher of those behind which it is one half or less;
    and their number from bit 16 on.
    """
    address, double, word = types.uintp, types.float64, types.int64
    signature = word(address, word, types.uint64, address, double, double, address, address, address)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        (
            keys,
            max_count,
            safe_key,
            alpha_table,
            transmittance,
            min_transmittance,
            alphas,
            weights,
            transmittance_after,
        ) = args
        # keys below the safe one come first, as they are sorted
        key = load(builder, keys, LONG8)
        valid = builder.icmp_unsigned("<", key, splat(builder, safe_key, I64))
        valid = builder.and_(valid, first_lanes_mask(builder, max_count))
        alpha = gather(builder, alpha_table, key_indices(builder, key, valid), FLOAT8)
        alpha = Vector(builder, builder.select(valid, alpha, ir.Constant(FLOAT8, [0.0] * LANES)))
        store(builder, alpha.value, alphas)
        alpha = alpha.to_float64()
        product = prefix_scan(builder, 1.0 - alpha, lambda a, b: a * b, 1.0)
        product_before = shift_lanes(builder, product, 1, 1.0)
        before_all = broadcast(builder, transmittance)
        transmittance_behind = product * before_all
        store(builder, (alpha * (product_before * before_all)).value, weights)
        store(builder, transmittance_behind.value, transmittance_after)  # running product of 1 - alpha
        count = builder.ctpop(Vector(builder, valid).to_bitmask())
        stops = (transmittance_behind < broadcast(builder, min_transmittance)).to_bitmask()
        halves = builder.shl((transmittance_behind <= 0.5).to_bitmask(), ir.Constant(I64, LANES))
        count = builder.shl(count, ir.Constant(I64, 2 * LANES))
        return builder.or_(builder.or_(stops, halves), count)

    return signature, codegen


@intrinsic
def lookup_slots8(
    typingctx: TypingContext,
    keys: Address,
    count: int,
    candidate_table: Address,
    slot_table: Address,
    weights: Address,
    candidate_indices: Address,
    slots: Address,
    depth_sums: Address,
) -> Intrinsic:
    """Look up the candidates of the first ``count`` of eight hits, and their slots in the packet.

    Writes ``candidate_indices``, read from ``candidate_table`` at the places in the keys, and ``slots``,
    both int64; adds weights times distances to the eight ``depth_sums``. Bit k of the result: hit k has no
    slot yet.
    """
    address, word = types.uintp, types.int64
    signature = word(address, word, *(address,) * 6)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        keys, count, known_numbers, slot_of, weights, numbers, slots, depths = args
        key = load(builder, keys, LONG8)
        valid = first_lanes_mask(builder, count)
        number = gather(builder, known_numbers, key_indices(builder, key, valid), INT8)
        number = builder.zext(number, LONG8)
        slot = builder.sext(gather(builder, slot_of, number, INT8), LONG8)
        store(builder, number, numbers)
        store(builder, slot, slots)
        weight = VectorRows(builder, weights, DOUBLE8)[0]
        distance = keep_first_lanes(builder, Vector(builder, key_distances(builder, key)).to_float64(), count)
        store(builder, (VectorRows(builder, depths, DOUBLE8)[0] + weight * distance).value, depths)
        new = builder.icmp_signed("<", slot, ir.Constant(LONG8, [0] * LANES))
        return Vector(builder, builder.and_(new, valid)).to_bitmask()

    return signature, codegen


@intrinsic
def store_hits8(
    typingctx: TypingContext,
    keys: Address,
    count: int,
    alphas: Address,
    slots: Address,
    tables: HitTables,
    first_hit: int,
    out: HitStore,
) -> Intrinsic:
    """Store ``count`` of eight hits from ``first_hit`` on, 32 bits a number; what follows them is undefined.

    u and v are read from where the keys say.
    """
    address, word = types.uintp, types.int64
    signature = types.void(address, word, address, address, tables, word, out)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        keys, count, alphas, slots, tables, place, out = args
        known_us, known_vs = cgutils.unpack_tuple(builder, tables)
        key = load(builder, keys, LONG8)
        where = key_indices(builder, key, first_lanes_mask(builder, count))
        values = (
            load(builder, alphas, FLOAT8),
            key_distances(builder, key),
            gather(builder, known_us, where, FLOAT8),
            gather(builder, known_vs, where, FLOAT8),
            builder.trunc(load(builder, slots, LONG8), INT8),
        )
        for value, array in zip(values, cgutils.unpack_tuple(builder, out), strict=True):
            store(builder, value, element_address(builder, array, place, 4))
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def accumulate_color_normals(
    typingctx: TypingContext,
    sums: Address,
    color_normals: Address,
    slots: Address,
    weights: Address,
    count: int,
) -> Intrinsic:
    """Add to the eight ``sums`` what ``count`` Gaussians show, times their weights, one after the other.

    Row s of ``color_normals``, eight doubles, is what the one in slot s shows; ``slots`` are int64.
    """
    signature = types.void(types.uintp, types.uintp, types.uintp, types.uintp, types.int64)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        sums, shown, slots, weights, count = args
        slots = builder.inttoptr(slots, I64.as_pointer())
        weights = builder.inttoptr(weights, DOUBLE.as_pointer())
        total = cgutils.alloca_once_value(builder, VectorRows(builder, sums, DOUBLE8)[0].value)
        with cgutils.for_range(builder, count) as loop:
            slot = builder.load(builder.gep(slots, [loop.index]))
            weight = broadcast(builder, builder.load(builder.gep(weights, [loop.index])))
            row = VectorRows(builder, element_address(builder, shown, slot, 64), DOUBLE8)[0]
            added = Vector(builder, builder.load(total)) + weight * row
            builder.store(added.value, total)
        store(builder, builder.load(total), sums)
        return context.get_dummy_value()

    return signature, codegen
