"""Eight hits of a ray at a time, as explicit vectors: where they are, how opaque, and what light is left.

Addresses point to doubles, eight to a vector, unless said otherwise; stores may write up to eight values
where fewer count, so that arrays have room for eight more. No flag allows the compiler to change a result.
"""

import llvmlite.ir as ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from engine.trace.cpu.kernels_simd import DOUBLE8, FLOAT8, I64, LANES, Lanes, Vector, broadcast

I1, I32 = ir.IntType(1), ir.IntType(32)
FLOAT, DOUBLE = ir.FloatType(), ir.DoubleType()
INT8, MASK8 = ir.VectorType(I32, LANES), ir.VectorType(I1, LANES)
LONG8 = ir.VectorType(I64, LANES)
N_X, A_X, B_X, N_0, INNER, ALPHA_0 = 0, 3, 6, 9, 10, 11
ROWS = 12
"""Rows of a block of eight candidates: u (N.d) = A.d and v (N.d) = B.d, t (N.d) = n0."""


@intrinsic
def meet_block(
    typingctx, block, dx, dy, dz, t_min, t_max, first, tail, keys, powers, opacities, us, vs, numbers
):
    """Test the eight candidates of a block, from ``first`` on; how many octagons the ray meets.

    Of each that it meets between the two distances writes from place ``tail`` on, without gaps: a key, the
    float32 distance in the upper half and the place in the lower (uint64); the exponent -(u^2 + v^2)/2;
    and as 32-bit words the opacity, u, v and the number of the candidate. A ray that makes a cosine below
    1e-6 with the normal runs inside the plane and meets nothing.
    """
    double, single, address = types.float64, types.float32, types.uintp
    signature = types.int64(
        address, double, double, double, single, single, types.int64, types.int64, *(address,) * 6
    )

    def codegen(context, builder, sig, args):
        block, dx, dy, dz, t_min, t_max, first, tail, keys, powers, opacities, us, vs, numbers = args
        rows = Lanes(builder, block, DOUBLE8)
        d = [broadcast(builder, component) for component in (dx, dy, dz)]

        def along(row):
            return rows[row] * d[0] + rows[row + 1] * d[1] + rows[row + 2] * d[2]

        cosine = along(N_X)
        inverse = Vector(builder, ir.Constant(DOUBLE8, [1.0] * LANES)) / cosine
        u, v = along(A_X) * inverse, along(B_X) * inverse
        cos_22, sin_22 = 0.9238795325112867, 0.3826834323650898
        farthest = (abs(u) * cos_22 + abs(v) * sin_22).larger(abs(u) * sin_22 + abs(v) * cos_22)
        met = ((farthest <= rows[INNER]) & (abs(cosine) >= 1e-6)).value
        t = builder.fptrunc((rows[N_0] * inverse).value, FLOAT8)
        behind = builder.fcmp_ordered(">", t, splat(builder, t_min, FLOAT))
        before = builder.fcmp_ordered("<", t, splat(builder, t_max, FLOAT))
        met = builder.and_(met, builder.and_(behind, before))

        def write(value, array, size):
            packed = _compress(builder, value, met)
            _store(builder, packed, _offset(builder, array, tail, size))

        places = builder.add(splat(builder, tail, I64), ir.Constant(LONG8, list(range(LANES))))
        distance = builder.zext(_compress(builder, builder.bitcast(t, INT8), met), LONG8)
        key = builder.or_(builder.shl(distance, ir.Constant(LONG8, [32] * LANES)), places)
        _store(builder, key, _offset(builder, keys, tail, 8))
        write(((u * u + v * v) * -0.5).value, powers, 8)
        write(builder.fptrunc(rows[ALPHA_0].value, FLOAT8), opacities, 4)
        write(builder.fptrunc(u.value, FLOAT8), us, 4)
        write(builder.fptrunc(v.value, FLOAT8), vs, 4)
        number = builder.add(
            splat(builder, builder.trunc(first, I32), I32), ir.Constant(INT8, list(range(LANES)))
        )
        write(number, numbers, 4)
        bits = builder.zext(builder.bitcast(met, ir.IntType(LANES)), I64)
        return builder.ctpop(bits)

    return signature, codegen


@intrinsic
def write_alphas(typingctx, powers, opacities, place, alpha_max):
    """Eight exponents from ``place`` on become alphas: opacity exp(power), at most the max, as float32.

    The exponential is right to a relative 1e-8 for |power| < 700.
    """
    signature = types.void(types.uintp, types.uintp, types.int64, types.float64)

    def codegen(context, builder, sig, args):
        powers, opacities, place, alpha_max = args
        at = _offset(builder, powers, place, 8)
        opacity = Lanes(builder, _offset(builder, opacities, place, 4), FLOAT8)[0]
        found = opacity * _exponential(builder, Lanes(builder, at, DOUBLE8)[0])
        found = found.smaller(broadcast(builder, alpha_max))
        rounded = builder.fpext(builder.fptrunc(found.value, FLOAT8), DOUBLE8)
        _store(builder, rounded, at)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def weigh(typingctx, alphas, count, t, stop_below, weights, after):
    """Weights of the first ``count`` of eight hits before which the transmittance is ``t``.

    Writes alpha T to ``weights`` and the transmittance behind each to ``after``; beyond ``count`` no hit
    changes anything. The bits of the result: those behind which it is below ``stop_below``; and, eight bits
    higher, those behind which it is one half or less.
    """
    signature = types.int64(types.uintp, types.int64, types.float64, types.float64, types.uintp, types.uintp)

    def codegen(context, builder, sig, args):
        alphas, count, t, stop_below, weights, after = args
        alpha = _first(builder, Lanes(builder, alphas, DOUBLE8)[0], count)
        one = Vector(builder, ir.Constant(DOUBLE8, [1.0] * LANES))
        product = scan(builder, one - alpha, lambda a, b: a * b, 1.0)
        through = shifted(builder, product, 1, 1.0)
        begin = broadcast(builder, t)
        left = product * begin
        _store(builder, (alpha * (through * begin)).value, weights)
        _store(builder, left.value, after)
        stops = (left < broadcast(builder, stop_below)).mask()
        halves = builder.shl((left <= 0.5).mask(), ir.Constant(I64, LANES))
        return builder.or_(stops, halves)

    return signature, codegen


@intrinsic
def add_shown(typingctx, sums, shown, slots, weights, count):
    """Add to the eight ``sums`` what ``count`` Gaussians show, times their weights, one after the other.

    Row s of ``shown``, eight doubles, is what the one in slot s shows; ``slots`` are int64.
    """
    signature = types.void(types.uintp, types.uintp, types.uintp, types.uintp, types.int64)

    def codegen(context, builder, sig, args):
        sums, shown, slots, weights, count = args
        slots = builder.inttoptr(slots, I64.as_pointer())
        weights = builder.inttoptr(weights, DOUBLE.as_pointer())
        total = cgutils.alloca_once_value(builder, Lanes(builder, sums, DOUBLE8)[0].value)
        with cgutils.for_range(builder, count) as loop:
            slot = builder.load(builder.gep(slots, [loop.index]))
            weight = broadcast(builder, builder.load(builder.gep(weights, [loop.index])))
            row = Lanes(builder, _offset(builder, shown, slot, 64), DOUBLE8)[0]
            added = Vector(builder, builder.load(total)) + weight * row
            builder.store(added.value, total)
        _store(builder, builder.load(total), sums)
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def share_out(typingctx, alphas, through, values, count, behind, alpha_max, weights, shares):
    """Backwards through the first ``count`` of eight hits: their weights and h = dL/d ln(alpha), as float32.

    Args are the float32 alphas, the transmittance before each, dL by a weight of one of each, and dL by what
    lies behind the last, summed from the back. Returns that by what lies behind the hit before the first.
    An alpha of ``alpha_max`` (float32) was clamped: its h is zero.
    """
    address, double = types.uintp, types.float64
    signature = double(address, address, address, types.int64, double, types.float32, address, address)

    def codegen(context, builder, sig, args):
        alphas, through, values, count, behind, alpha_max, weights, shares = args
        alpha = Lanes(builder, alphas, FLOAT8)[0]
        limit = broadcast(builder, builder.fpext(alpha_max, DOUBLE))
        clamped = alpha >= limit
        alpha = _first(builder, alpha, count)
        through = Lanes(builder, through, DOUBLE8)[0]
        value = Lanes(builder, values, DOUBLE8)[0]
        one = Vector(builder, ir.Constant(DOUBLE8, [1.0] * LANES))
        weight = _first(builder, alpha * through, count)
        seen = _first(builder, weight * value, count)
        sums = scan(builder, seen, lambda a, b: a + b, 0.0, backwards=True)
        later = shifted(builder, sums, -1, 0.0) + broadcast(builder, behind)
        h = (through * value - later / (one - alpha)) * alpha
        h = clamped.where(0.0, h)
        _store(builder, builder.fptrunc(weight.value, FLOAT8), weights)
        _store(builder, builder.fptrunc(h.value, FLOAT8), shares)
        first = builder.extract_element(sums.value, ir.Constant(I32, 0))
        return builder.fadd(first, behind)

    return signature, codegen


@intrinsic
def add_moments(typingctx, row, h, u, v, weight, by_ray):
    """Add one hit to the row of its Gaussian, sixteen float32.

    The first eight are the moments h (1, u, v, u^2, u v, v^2, u (u^2 + v^2), v (u^2 + v^2)); the others get
    ``weight`` times the eight float32 at ``by_ray``, but for the second of them, which counts.
    """
    single = types.float32
    signature = types.void(types.uintp, single, single, single, single, types.uintp)

    def codegen(context, builder, sig, args):
        row, h, u, v, weight, by_ray = args
        one = ir.Constant(FLOAT, 1.0)
        square = builder.fadd(
            builder.fmul(u, u, ("contract",)), builder.fmul(v, v, ("contract",)), ("contract",)
        )
        sides = _lanes(builder, (one, u, v, u, u, v, u, v))
        others = _lanes(builder, (one, one, one, u, v, v, square, square))
        moments = builder.fmul(builder.fmul(sides, others), splat(builder, h, FLOAT))
        at = builder.inttoptr(row, FLOAT8.as_pointer())
        builder.store(builder.fadd(builder.load(at, align=4), moments), at, align=4)
        at = builder.inttoptr(_offset(builder, row, ir.Constant(I64, 8), 4), FLOAT8.as_pointer())
        ray = builder.load(builder.inttoptr(by_ray, FLOAT8.as_pointer()), align=4)
        sums = builder.fadd(
            builder.load(at, align=4),
            builder.fmul(ray, splat(builder, weight, FLOAT), ("contract",)),
            ("contract",),
        )
        count = ir.Constant(FLOAT8, [0.0, 1.0, *[0.0] * 6])
        builder.store(builder.fadd(sums, count), at, align=4)
        return context.get_dummy_value()

    return signature, codegen


def scan(builder, vector, combine, neutral, backwards=False):
    """Each lane with all before it, or behind it, combined in three steps."""
    for step in (1, 2, 4):
        vector = combine(vector, shifted(builder, vector, -step if backwards else step, neutral))
    return vector


def shifted(builder, vector, by, filling):
    """Lane k moves to lane k + ``by``; ``filling`` comes in."""
    fill = ir.Constant(DOUBLE8, [float(filling)] * LANES)
    places = [k - by if 0 <= k - by < LANES else LANES for k in range(LANES)]
    order = ir.Constant(ir.VectorType(I32, LANES), places)
    return Vector(builder, builder.shuffle_vector(vector.value, fill, order))


def splat(builder, scalar, kind):
    """A vector of eight times ``scalar``."""
    vector = ir.VectorType(kind, LANES)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(I32, 0))
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), ir.Constant(INT8, [0] * LANES))


def _lanes(builder, scalars):
    vector = ir.Constant(FLOAT8, ir.Undefined)
    for k, scalar in enumerate(scalars):
        vector = builder.insert_element(vector, scalar, ir.Constant(I32, k))
    return vector


def _first(builder, vector, count):
    """The first ``count`` lanes; zero in the others."""
    lanes = ir.Constant(LONG8, list(range(LANES)))
    valid = builder.icmp_signed("<", lanes, splat(builder, count, I64))
    return Vector(builder, builder.select(valid, vector.value, ir.Constant(DOUBLE8, [0.0] * LANES)))


def _compress(builder, value, mask):
    """The lanes of ``mask`` without gaps, in order; what follows them is undefined."""
    element = {FLOAT: "f32", DOUBLE: "f64", I32: "i32"}[value.type.element]
    kind = ir.FunctionType(value.type, [value.type, MASK8, value.type])
    function = cgutils.get_or_insert_function(
        builder.module, kind, f"llvm.experimental.vector.compress.v8{element}"
    )
    return builder.call(function, [value, mask, ir.Constant(value.type, ir.Undefined)])


def _offset(builder, address, place, size):
    return builder.add(address, builder.mul(place, ir.Constant(I64, size)))


def _store(builder, value, address):
    builder.store(value, builder.inttoptr(address, value.type.as_pointer()), align=4)


def _exponential(builder, x):
    """Exponentials of eight doubles: 2^n times a polynomial of what is left, at most half of ln 2."""
    shift = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to a whole number, which the low bits then are
    moved = x * 1.4426950408889634 + shift
    n = moved - shift
    r = x - n * 0.6931471805599453
    p = r * (1.0 / 40320.0) + 1.0 / 5040.0
    for term in (1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0):
        p = p * r + term
    bits = builder.shl(builder.bitcast(moved.value, LONG8), ir.Constant(LONG8, [52] * LANES))
    bits = builder.add(bits, ir.Constant(LONG8, [1023 << 52] * LANES))
    return p * Vector(builder, builder.bitcast(bits, DOUBLE8))
