"""Sixteen rays of a packet at a time against one Gaussian, as explicit vectors of float32.

What is known of the packet's rays lies in rows of 64 numbers, a lane for each ray; so does what they have
seen so far, and what goes back along them. A Gaussian is a line of sixteen numbers: the twelve of a row of
:mod:`octasplat.engine.trace.cpu.kernels.simd8`, its color, and nothing. No flag allows the compiler to
change a result.
"""

from collections.abc import Callable, Sequence

import llvmlite.ir as ir
from numba import types
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.trace.cpu.kernels.simd8 import A_X, ALPHA_0, B_X, INNER_RADIUS_ROW, N_0, N_X
from octasplat.engine.trace.cpu.kernels.simd_vector import I64, Vector, VectorRows, broadcast, exp_float32
from octasplat.engine.trace.kernels.native import Address, Intrinsic

GROUP_SIZE = 16
GROUPS = 4
"""Groups of sixteen rays in a packet."""
PACKET_RAYS = GROUP_SIZE * GROUPS
FLOAT, I32 = ir.FloatType(), ir.IntType(32)
FLOAT16, INT16 = ir.VectorType(FLOAT, GROUP_SIZE), ir.VectorType(I32, GROUP_SIZE)
MASK16 = ir.VectorType(ir.IntType(1), GROUP_SIZE)
ZEROS, ONES = ir.Constant(FLOAT16, [0.0] * GROUP_SIZE), ir.Constant(FLOAT16, [1.0] * GROUP_SIZE)

SLOPE_A, SLOPE_B, PER_AXIS, T_MIN, T_MAX = range(5)
RAY_ROWS = 5
"""Of each ray: its slopes, its length over its way along the axis, and between which distances it sees."""
TRANSMITTANCE, RED, GREEN, BLUE, DEPTH, MEDIAN, NORMAL_0, NORMAL_1, NORMAL_2, COUNT = range(10)
STATE_ROWS = 10
"""What each ray has seen: the transmittance that is left, sums of color, distance and normal, the median
distance, and the number of its hits."""
ALPHA, DISTANCE = range(2)
HIT_ROWS = 2
"""Where each ray meets the Gaussian that is being tested."""
GRAD_RED, GRAD_GREEN, GRAD_BLUE, ERROR, GRAD_BEHIND, TRANSMITTANCE_BEHIND = range(6)
BACKWARD_ROWS = 6
"""Backwards: dL by each ray's color, its error, dL by what lies behind, and the transmittance there."""
PACKET_PRIMITIVE_WORDS = 16
COLOR = 12
"""Where a line has its color; before it are the rows of :mod:`octasplat.engine.trace.cpu.kernels.simd8`."""
MOMENTS = 14
"""Sums of a Gaussian over the rays.

A row of :mod:`octasplat.engine.trace.cpu.kernels.moment_rows` begins so.
"""


def _group_rows(builder: ir.IRBuilder, address: ir.Value, group: ir.Value) -> VectorRows:
    """Return the sixteen lanes of a group in rows of 64 numbers."""
    offset = builder.mul(group, ir.Constant(I64, GROUP_SIZE * 4))
    return VectorRows(builder, builder.add(address, offset), FLOAT16, row_bytes=PACKET_RAYS * 4)


def _word_loader(builder: ir.IRBuilder, address: ir.Value) -> Callable[[int], Vector]:
    """Return a function that reads one number of an array into all lanes."""
    words = builder.inttoptr(address, FLOAT.as_pointer())
    return lambda k: broadcast(builder, builder.load(builder.gep(words, [ir.Constant(I64, k)])), GROUP_SIZE)


def _mask_lanes(builder: ir.IRBuilder, mask: ir.Value, vector: Vector) -> Vector:
    """Return the lanes of a mask; zero in the others."""
    return Vector(builder, builder.select(mask, vector.value, ZEROS))


def _plane_uv(rays: VectorRows, primitive: Callable[[int], Vector]) -> tuple[Vector, Vector, Vector, Vector]:
    """Return u, v, the cosine times the length over the way along the axis, and one over that."""

    def along(row: int) -> Vector:
        return primitive(row + 2) * rays[SLOPE_B] + (primitive(row + 1) * rays[SLOPE_A] + primitive(row))

    slant = along(N_X)
    inverse = 1.0 / slant
    return along(A_X) * inverse, along(B_X) * inverse, slant, inverse


def _eval_alpha(
    builder: ir.IRBuilder, u: Vector, v: Vector, primitive: Callable[[int], Vector], alpha_max: ir.Value
) -> Vector:
    power = (u * u + v * v) * -0.5
    return (primitive(ALPHA_0) * exp_float32(builder, power)).minimum(
        broadcast(builder, alpha_max, GROUP_SIZE)
    )


@intrinsic
def intersect_group16(
    typingctx: TypingContext,
    primitive: Address,
    rays: Address,
    state_rows: Address,
    hit_rows: Address,
    group: int,
    min_transmittance: float,
    alpha_max: float,
    max_hits: float,
) -> Intrinsic:
    """Test a group of rays against a Gaussian; bit k: its ray k meets the octagon and goes on till there.

    Writes their alphas (0 for the others) and distances to ``hit_rows``. A ray goes on while it has
    ``min_transmittance`` and fewer than ``max_hits``.
    """
    address, single = types.uintp, types.float32
    signature = types.int64(*(address,) * 4, types.int64, single, single, single)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        line, rays, seen, met, group, least_left, alpha_max, most_hits = args
        line = _word_loader(builder, line)
        rays, seen, met = (_group_rows(builder, at, group) for at in (rays, seen, met))
        u, v, slant, inverse = _plane_uv(rays, line)
        # edge normals of the octagon; the absolute values map all eight to two
        cos_22, sin_22 = 0.9238795325112867, 0.3826834323650898
        farthest = (abs(u) * cos_22 + abs(v) * sin_22).maximum(abs(u) * sin_22 + abs(v) * cos_22)
        t = line(N_0) * inverse * rays[PER_AXIS]
        here = (farthest <= line(INNER_RADIUS_ROW)) & (abs(slant) >= rays[PER_AXIS] * 1e-6)
        here = here & (t > rays[T_MIN]) & (t < rays[T_MAX])
        # a ray that has ended, or reached its limit of hits, takes no part
        here = here & (seen[TRANSMITTANCE] >= broadcast(builder, least_left, GROUP_SIZE))
        here = here & (seen[COUNT] < broadcast(builder, most_hits, GROUP_SIZE))
        met[ALPHA] = _mask_lanes(builder, here.value, _eval_alpha(builder, u, v, line, alpha_max))
        met[DISTANCE] = _mask_lanes(builder, here.value, t)
        return here.to_bitmask()

    return signature, codegen


@intrinsic
def composite_group16(
    typingctx: TypingContext,
    primitive: Address,
    normal: Address,
    state_rows: Address,
    hit_rows: Address,
    group: int,
    ray_mask: int,
    min_transmittance: float,
) -> Intrinsic:
    """Composite a Gaussian into those rays of a group, the ``ray_mask``, that have ``hit_rows`` it.

    ``normal`` are three numbers, turned. Bit k of the result: ray k has ``min_transmittance`` behind it.
    """
    address, word = types.uintp, types.int64
    signature = word(*(address,) * 4, word, word, types.float32)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        line, normal, seen, met, group, bits, least_left = args
        line, normal = _word_loader(builder, line), _word_loader(builder, normal)
        seen, met = _group_rows(builder, seen, group), _group_rows(builder, met, group)
        here = builder.bitcast(builder.trunc(bits, ir.IntType(GROUP_SIZE)), MASK16)
        # Lanes that are not hit have alpha 0, so that they keep their sums and transmittance.
        alpha, before = met[ALPHA], seen[TRANSMITTANCE]
        weight = before * alpha
        for axis in range(3):
            seen[RED + axis] = weight * line(COLOR + axis) + seen[RED + axis]
            seen[NORMAL_0 + axis] = weight * normal(axis) + seen[NORMAL_0 + axis]
        seen[DEPTH] = weight * met[DISTANCE] + seen[DEPTH]
        after = before * (1.0 - alpha)
        halves = (before > 0.5) & (after <= 0.5)
        seen[MEDIAN] = halves.select(met[DISTANCE], seen[MEDIAN])
        seen[COUNT] = seen[COUNT] + _mask_lanes(builder, here, Vector(builder, ONES))
        seen[TRANSMITTANCE] = after
        return (after >= broadcast(builder, least_left, GROUP_SIZE)).to_bitmask()

    return signature, codegen


@intrinsic
def backward_group16(
    typingctx: TypingContext,
    primitive: Address,
    rays: Address,
    backward_rows: Address,
    moments: Address,
    group: int,
    ray_mask: int,
    alpha_max: float,
) -> Intrinsic:
    """Propagate gradients back over a Gaussian that those rays of a group, the ``ray_mask``, have hit.

    With h = dL/d ln(alpha) adds to the ``moments``, rows of sixteen, lane by lane: h times 1, u, v, u^2, u v,
    v^2, u (u^2 + v^2) and v (u^2 + v^2); weights, counts, weights times errors and times dL by each color.
    What was clamped to ``alpha_max`` has no h. The transmittance before a hit is what lies behind it over
    1 - alpha, so that nothing but the line and the bits need be kept of it.
    """
    address, word = types.uintp, types.int64
    signature = types.void(*(address,) * 4, word, word, types.float32)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        line, rays, back, moments, group, bits, alpha_max = args
        line = _word_loader(builder, line)
        rays, back = _group_rows(builder, rays, group), _group_rows(builder, back, group)
        moments = VectorRows(builder, moments, FLOAT16)
        here = builder.bitcast(builder.trunc(bits, ir.IntType(GROUP_SIZE)), MASK16)
        u, v, _slant, _inverse = _plane_uv(rays, line)
        # lanes that are not hit may hold infinities, which zero weights would not cancel
        u, v = _mask_lanes(builder, here, u), _mask_lanes(builder, here, v)
        alpha = _mask_lanes(builder, here, _eval_alpha(builder, u, v, line, alpha_max))
        per_passed = 1.0 / (1.0 - alpha)
        transmittance = back[TRANSMITTANCE_BEHIND] * per_passed
        weight = transmittance * alpha
        slopes = [back[GRAD_RED + channel] for channel in range(3)]
        value = slopes[0] * line(COLOR) + slopes[1] * line(COLOR + 1) + slopes[2] * line(COLOR + 2)
        h = (transmittance * value - back[GRAD_BEHIND] * per_passed) * alpha  # dL/dalpha times alpha
        h = (alpha >= broadcast(builder, alpha_max, GROUP_SIZE)).select(0.0, h)
        back[GRAD_BEHIND] = weight * value + back[GRAD_BEHIND]
        back[TRANSMITTANCE_BEHIND] = transmittance
        hu, hv, square = h * u, h * v, u * u + v * v
        count = _mask_lanes(builder, here, Vector(builder, ONES))
        found = (h, hu, hv, hu * u, hu * v, hv * v, hu * square, hv * square, weight, count,
                 weight * back[ERROR], *(weight * slope for slope in slopes))  # fmt: skip
        for k, vector in enumerate(found):
            moments[k] = moments[k] + vector
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def reduce_moments(typingctx: TypingContext, moments: Address, row: Address) -> Intrinsic:
    """Write the sums over the lanes of all :data:`MOMENTS`, and two zeros, to sixteen numbers.

    Two rows become one by adding halves, the lanes of either row beside each other, until a lane is a row.
    """
    signature = types.void(types.uintp, types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        moments = VectorRows(builder, args[0], FLOAT16)
        rows = [moments[k].value if k < MOMENTS else ZEROS for k in range(GROUP_SIZE)]
        size = GROUP_SIZE  # lanes of each of the rows that share a vector
        while len(rows) > 1:
            count, half = len(rows) // 2, size // 2

            def halves(
                first: int,
                begin: int,
                size: int = size,
                half: int = half,
                count: int = count,
                rows: list[ir.Value] = rows,
            ) -> ir.Value:
                places = [
                    (group % 2) * GROUP_SIZE + group // 2 * size + begin + lane
                    for group in range(GROUP_SIZE // half)
                    for lane in range(half)
                ]
                return builder.shuffle_vector(rows[first], rows[first + count], ir.Constant(INT16, places))

            rows = [builder.fadd(halves(k, 0), halves(k, half)) for k in range(count)]
            size = half
        VectorRows(builder, args[1], FLOAT16)[0] = Vector(builder, rows[0])
        return context.get_dummy_value()

    return signature, codegen
