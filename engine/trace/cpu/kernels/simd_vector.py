"""Vectors as explicit values, and the tests of a packet's walk, eight lanes at a time.

Loop vectorisers leave these short loops scalar. The intrinsics emit vectors of eight float32, one register
of AVX2, or of eight doubles, which the compiler maps to whatever the processor has; no flag allows it to
change a result.
"""

from collections.abc import Sequence
from typing import Any

import llvmlite.ir as ir
from numba import types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.trace.kernels.native import Address, Intrinsic

LANES = 8
I64 = ir.IntType(64)
DOUBLE8 = ir.VectorType(ir.DoubleType(), LANES)
FLOAT8 = ir.VectorType(ir.FloatType(), LANES)
FRUSTUM_PLANES = 5
"""Planes of a pyramid: four through its sides, one through its apex across the axis."""
PLANE_WORDS = 9
ROUNDING_MARGIN = 2e-6
"""Room for rounding where candidates are sought in float32, as a fraction of the numbers that go in: some
thirty roundings, while a sum of three products with differences and normals has eight."""


class Vector:
    """A vector value with the operators that the formulas need; numbers become lanes of its own type."""

    def __init__(self, builder: ir.IRBuilder, value: ir.Value) -> None:
        self.builder, self.value = builder, value

    def _operand(self, other: "Vector | float") -> ir.Value:
        if isinstance(other, Vector):
            return other.value
        return ir.Constant(self.value.type, [float(other)] * self.value.type.count)

    def __add__(self, other: "Vector | float") -> "Vector":
        return Vector(self.builder, self.builder.fadd(self.value, self._operand(other), flags=("contract",)))

    def __sub__(self, other: "Vector | float") -> "Vector":
        return Vector(self.builder, self.builder.fsub(self.value, self._operand(other), flags=("contract",)))

    def __mul__(self, other: "Vector | float") -> "Vector":
        return Vector(self.builder, self.builder.fmul(self.value, self._operand(other), flags=("contract",)))

    def __truediv__(self, other: "Vector | float") -> "Vector":
        return Vector(self.builder, self.builder.fdiv(self.value, self._operand(other)))

    def __rtruediv__(self, other: "Vector | float") -> "Vector":
        return Vector(self.builder, self.builder.fdiv(self._operand(other), self.value))

    def __rsub__(self, other: "Vector | float") -> "Vector":
        return Vector(self.builder, self.builder.fsub(self._operand(other), self.value, flags=("contract",)))

    def _compare(self, operator: str, other: "Vector | float") -> "Vector":
        return Vector(self.builder, self.builder.fcmp_ordered(operator, self.value, self._operand(other)))

    def __le__(self, other: "Vector | float") -> "Vector":
        return self._compare("<=", other)

    def __lt__(self, other: "Vector | float") -> "Vector":
        return self._compare("<", other)

    def __ge__(self, other: "Vector | float") -> "Vector":
        return self._compare(">=", other)

    def __gt__(self, other: "Vector | float") -> "Vector":
        return self._compare(">", other)

    def __and__(self, other: "Vector") -> "Vector":
        return Vector(self.builder, self.builder.and_(self.value, other.value))

    def __invert__(self) -> "Vector":
        return Vector(self.builder, self.builder.not_(self.value))

    def __abs__(self) -> "Vector":
        kind = self.value.type
        width = 64 if kind.element == DOUBLE8.element else 32
        integers = ir.VectorType(ir.IntType(width), kind.count)
        no_sign = ir.Constant(integers, [(1 << (width - 1)) - 1] * kind.count)  # all bits but the sign
        bits = self.builder.and_(self.builder.bitcast(self.value, integers), no_sign)
        return Vector(self.builder, self.builder.bitcast(bits, self.value.type))

    def maximum(self, other: "Vector | float") -> "Vector":
        """Return the larger of two lanes; the second where they cannot be compared."""
        return Vector(
            self.builder, self.builder.select((self > other).value, self.value, self._operand(other))
        )

    def minimum(self, other: "Vector | float") -> "Vector":
        """Return the smaller of two lanes; the second where they cannot be compared."""
        return Vector(
            self.builder, self.builder.select((self < other).value, self.value, self._operand(other))
        )

    def select(self, if_true: "Vector | float", if_false: "Vector | float") -> "Vector":
        """Return lanes of ``if_true`` where this comparison holds, else those of ``if_false``."""
        lanes = if_true if isinstance(if_true, Vector) else if_false
        assert isinstance(lanes, Vector), "one of the two must be a vector"
        return Vector(
            self.builder, self.builder.select(self.value, lanes._operand(if_true), lanes._operand(if_false))
        )

    def sqrt(self) -> "Vector":
        """Return the square root of each lane."""
        kind = self.value.type
        name = "llvm.sqrt.v8f64" if kind == DOUBLE8 else "llvm.sqrt.v8f32"
        function = cgutils.get_or_insert_function(self.builder.module, ir.FunctionType(kind, [kind]), name)
        return Vector(self.builder, self.builder.call(function, [self.value]))

    def to_float64(self) -> "Vector":
        """Return the same numbers of float32 lanes as doubles."""
        return Vector(self.builder, self.builder.fpext(self.value, DOUBLE8))

    def to_int32(self) -> "Vector":
        """Convert to int32, rounded towards zero; the lanes must fit."""
        return Vector(self.builder, self.builder.fptosi(self.value, ir.VectorType(ir.IntType(32), LANES)))

    def to_bitmask(self) -> ir.Value:
        """Return truth of the lanes as the low bits of an int64."""
        return self.builder.zext(self.builder.bitcast(self.value, ir.IntType(self.value.type.count)), I64)


class VectorRows:
    """Loads and stores rows of lanes at an address, ``row_bytes`` apart: without gaps unless told."""

    def __init__(
        self, builder: ir.IRBuilder, address: ir.Value, element: ir.Type, row_bytes: int = 0
    ) -> None:
        self.builder = builder
        self.element = element
        self.address = address
        self.row_bytes = row_bytes or element.count * (8 if element == DOUBLE8 else 4)

    def _pointer(self, row: int | ir.Value) -> ir.Value:
        offset = (
            ir.Constant(I64, row * self.row_bytes)
            if isinstance(row, int)
            else self.builder.mul(row, ir.Constant(I64, self.row_bytes))
        )
        address = self.builder.add(self.address, offset)
        return self.builder.inttoptr(address, self.element.as_pointer())

    def __getitem__(self, row: int | ir.Value) -> Vector:
        return Vector(self.builder, self.builder.load(self._pointer(row), align=4))

    def __setitem__(self, row: int | ir.Value, vector: Vector) -> None:
        self.builder.store(vector.value, self._pointer(row), align=4)


def broadcast(builder: ir.IRBuilder, scalar: ir.Value, lanes: int = LANES) -> Vector:
    """Return a vector of so many times the same float32 or double."""
    nothing = ir.Constant(ir.VectorType(scalar.type, lanes), ir.Undefined)
    one = builder.insert_element(nothing, scalar, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
    return Vector(builder, builder.shuffle_vector(one, nothing, zeros))


def exp_float32(builder: ir.IRBuilder, x: Vector) -> Vector:
    """Return exponentials of float32: 2^n times a polynomial of what is left, at most half of ln 2.

    Right to a relative 1e-7 for |x| < 87. The polynomial and ln 2 in two parts, the first of which times n is
    exact, are those of Cephes' expf (https://www.netlib.org/cephes/).
    """
    count = x.value.type.count
    integers = ir.VectorType(ir.IntType(32), count)
    shift = 12582912.0  # 1.5 * 2^23: adding it rounds to a whole number, which the low bits then are
    moved = x * 1.4426950408889634 + shift
    n = moved - shift
    r = x - n * 0.693359375 + n * 2.12194440e-4
    p = r * 1.9875691500e-4 + 1.3981999507e-3
    for term in (8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1, 1.0, 1.0):
        p = p * r + term
    # n as the exponent's bits of 2^n
    bits = builder.shl(builder.bitcast(moved.value, integers), ir.Constant(integers, [23] * count))
    bits = builder.add(bits, ir.Constant(integers, [127 << 23] * count))
    return p * Vector(builder, builder.bitcast(bits, x.value.type))


def sum_abs(vectors: Sequence[Vector]) -> Vector:
    """Sum of the magnitudes of several vectors."""
    total = abs(vectors[0])
    for vector in vectors[1:]:
        total = total + abs(vector)
    return total


@intrinsic
def boxes_in_frustum(
    typingctx: TypingContext, node: Address, planes: Address, ox: float, oy: float, oz: float
) -> Intrinsic:
    """Return a mask; bit k: box k of a node overlaps the frustum with apex o and five inward ``planes``.

    Row s of the planes is a normal, its positive parts and its negative ones, float32. A box turned inside
    out, whose corners are infinite, is in no pyramid.
    """
    signature = types.int64(types.uintp, types.uintp, *(types.float32,) * 3)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        rows = VectorRows(builder, args[0], FLOAT8)
        o = [broadcast(builder, component) for component in args[2:]]
        low, high = ([rows[first + axis] - o[axis] for axis in range(3)] for first in (0, 3))
        room = sum_abs([abs(a).maximum(abs(b)) for a, b in zip(low, high, strict=True)]) * ROUNDING_MARGIN
        inside: Vector | None = None
        for side in range(FRUSTUM_PLANES):
            distance = room
            for axis in range(3):  # that of the corner farthest along the normal
                distance = distance + high[axis] * _plane_component(builder, args[1], side, 3 + axis)
                distance = distance + low[axis] * _plane_component(builder, args[1], side, 6 + axis)
            here = distance >= 0.0
            inside = here if inside is None else inside & here
        assert inside is not None
        return inside.to_bitmask()

    return signature, codegen


@intrinsic
def ellipses_in_frustum(
    typingctx: TypingContext, block: Address, planes: Address, ox: float, oy: float, oz: float
) -> Intrinsic:
    """Return a mask; bit k: ellipse k of a block overlaps the frustum; see :func:`boxes_in_frustum`.

    Its farthest point inwards along a normal lies sqrt(u^2 + v^2) beyond its centre, u and v being its legs
    along the normal.
    """
    signature = types.int64(types.uintp, types.uintp, *(types.float32,) * 3)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        rows = VectorRows(builder, args[0], FLOAT8)
        centre = [rows[axis] - broadcast(builder, args[2 + axis]) for axis in range(3)]
        legs = [rows[3 + k] for k in range(6)]
        room = sum_abs([*centre, *legs]) * ROUNDING_MARGIN
        inside: Vector | None = None
        for side in range(FRUSTUM_PLANES):
            n = [_plane_component(builder, args[1], side, axis) for axis in range(3)]
            height = centre[0] * n[0] + centre[1] * n[1] + centre[2] * n[2] + room
            u = legs[0] * n[0] + legs[1] * n[1] + legs[2] * n[2]
            v = legs[3] * n[0] + legs[4] * n[1] + legs[5] * n[2]
            # the centre is outside by more than its legs reach
            outside = (height < 0.0) & (height * height > u * u + v * v)
            inside = ~outside if inside is None else inside & ~outside
        assert inside is not None
        return inside.to_bitmask()

    return signature, codegen


def _plane_component(builder: ir.IRBuilder, planes: ir.Value, side: int, column: int) -> Vector:
    """Broadcast one number of a normal's row to all lanes."""
    words = builder.inttoptr(planes, ir.FloatType().as_pointer())
    place = ir.Constant(I64, side * PLANE_WORDS + column)
    return broadcast(builder, builder.load(builder.gep(words, [place])))


@intrinsic
def lowest_bit(typingctx: TypingContext, mask: int) -> Intrinsic:
    """Return place of the lowest bit that is set; ``mask`` must not be zero."""
    signature = types.int64(types.int64)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        # a zero mask is undefined: one instruction less
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return signature, codegen


def _reinterpret(source: types.Type, target: types.Type) -> Any:
    @intrinsic
    def reinterpret(typingctx: TypingContext, value: float) -> Intrinsic:
        signature = target(source)

        def codegen(
            context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
        ) -> ir.Value:
            return builder.bitcast(args[0], context.get_value_type(target))

        return signature, codegen

    return reinterpret


float32_bits = _reinterpret(types.float32, types.uint32)
float32_from_bits = _reinterpret(types.uint32, types.float32)
