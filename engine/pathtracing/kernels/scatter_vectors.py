"""What scattering at surfaces begins with, of eight rows at a time: samples of a lamp, and ways on.

Roots and divisions follow each other in it; one row alone spends most of its time waiting for them.
"""

import math
from collections.abc import Sequence

import llvmlite.ir as ir
from numba import types
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.pathtracing.kernels.surface_point_vectors import RAY_STEP_ROW
from octasplat.engine.trace.cpu.kernels.simd_ops import DOUBLE, INT8
from octasplat.engine.trace.cpu.kernels.simd_vector import DOUBLE8, I64, LANES, Vector, VectorRows, broadcast
from octasplat.engine.trace.kernels.native import Address, Intrinsic

LAMP_SAMPLE_ROWS = 8
"""Rows of a block of a lamp's samples: the point off the surface, the way to the lamp, distance, density."""
WAY_ROWS = 4
"""Rows of a block of diffuse ways on: direction and density."""
_VectorXyz = list[Vector]


def _dot(a: _VectorXyz, b: _VectorXyz) -> Vector:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _ones(builder: ir.IRBuilder) -> Vector:
    return Vector(builder, ir.Constant(DOUBLE8, [1.0] * LANES))


def _numbers(builder: ir.IRBuilder, address: ir.Value, count: int) -> list[Vector]:
    """Return each of the ``count`` doubles at an address in all lanes."""
    pointer = builder.inttoptr(address, DOUBLE.as_pointer())
    return [
        broadcast(builder, builder.load(builder.gep(pointer, [ir.Constant(I64, k)]))) for k in range(count)
    ]


@intrinsic
def write_lamp_samples8(
    typingctx: TypingContext,
    points: Address,
    row_bytes: int,
    first: Address,
    second: Address,
    position: Address,
    side_u: Address,
    side_v: Address,
    axis: Address,
    area: Address,
    out: Address,
) -> Intrinsic:
    """Write samples of a rectangle for eight points of surfaces, in :data:`LAMP_SAMPLE_ROWS` rows of doubles.

    All but ``row_bytes``, that of ``points`` and ``out``, are addresses: of the rows of
    :func:`.surface_point_vectors.write_surface_points8`, of two uniform numbers of each, and of what
    :class:`.kernel_args.LightArrays` has of the lamp. As :func:`.lights.sample_light`, for points off the
    surface as by :func:`.surface.offset_ray_origin`; the density is 0 where the lamp does not shine.
    """
    signature = types.void(types.uintp, types.int64, *[types.uintp] * 8)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        rows, out = (_Rows(builder, args[place], args[1]) for place in (0, 9))
        u, v = (VectorRows(builder, args[place], DOUBLE8)[0] - 0.5 for place in (2, 3))
        position, side_u, side_v, axis = (_numbers(builder, args[place], 3) for place in (4, 5, 6, 7))
        place, normal = [rows[j] for j in range(3)], [rows[3 + j] for j in range(3)]
        # --- off the surface ---
        step = rows[RAY_STEP_ROW]
        place = [x + step * n for x, n in zip(place, normal, strict=True)]
        # --- to a place on the lamp ---
        way = [position[j] - place[j] + (u * side_u[j] + v * side_v[j]) for j in range(3)]
        squared = _dot(way, way).maximum(1e-20)
        along = _dot(axis, way) * -1.0
        distance = squared.sqrt()
        inverse = 1.0 / distance
        pdf = squared * distance / (along * _numbers(builder, args[8], 1)[0])
        pdf = (along <= distance * 1e-9).select(0.0, pdf)
        for j, value in enumerate([*place, *(inverse * x for x in way), distance, pdf]):
            out[j] = value
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def write_diffuse_ways8(
    typingctx: TypingContext, points: Address, row_bytes: int, first: Address, second: Address, out: Address
) -> Intrinsic:
    """Write ways on, as dense as their cosine, for eight points, in :data:`WAY_ROWS` rows of doubles.

    All but ``row_bytes``, that of ``points`` and ``out``, are addresses, see :func:`write_lamp_samples8`. As
    :func:`.principled_bsdf.sample_cosine` in the frame of :func:`.principled_bsdf.orthonormal_basis`.
    """
    signature = types.void(types.uintp, types.int64, *[types.uintp] * 3)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        rows, out = (_Rows(builder, args[place], args[1]) for place in (0, 4))
        u, v = (VectorRows(builder, args[place], DOUBLE8)[0] for place in (2, 3))
        s_x, s_y, s_z = (rows[6 + j] for j in range(3))
        # --- the frame of the shading normal ---
        sign = (s_z >= 0.0).select(_ones(builder), -1.0)
        a = -1.0 / (sign + s_z)
        b = s_x * s_y * a
        across = [sign * s_x * s_x * a + 1.0, sign * b, sign * -1.0 * s_x]
        up = [b, sign + s_y * s_y * a, s_y * -1.0]
        # --- the direction in it ---
        radius, i_z = u.sqrt(), (1.0 - u).maximum(0.0).sqrt()
        cosine, sine = _cos_sin_of_turns(builder, v)
        i_x, i_y = radius * cosine, radius * sine
        for j, s in enumerate((s_x, s_y, s_z)):
            out[j] = i_x * across[j] + i_y * up[j] + i_z * s
        out[3] = i_z / math.pi
        return context.get_dummy_value()

    return signature, codegen


def _cos_sin_of_turns(builder: ir.IRBuilder, v: Vector) -> tuple[Vector, Vector]:
    """See :func:`.principled_bsdf.cos_sin_of_turns`."""
    quarter = (v * 4.0 + 0.5).to_int32().value
    x = (v - Vector(builder, builder.sitofp(quarter, DOUBLE8)) * 0.25) * (2.0 * math.pi)
    x2 = x * x
    sine, cosine = 1 / 362880 - x2 * (1 / 39916800), x2 * (1 / 479001600) + -1 / 3628800
    for term in (-1 / 5040, 1 / 120, -1 / 6, 1.0):
        sine = x2 * sine + term
    for term in (1 / 40320, -1 / 720, 1 / 24, -1 / 2, 1.0):
        cosine = x2 * cosine + term
    sine = x * sine

    def has_bit(number: ir.Value, bit: int) -> Vector:
        bits = builder.and_(number, ir.Constant(INT8, [bit] * LANES))
        return Vector(builder, builder.icmp_unsigned("!=", bits, ir.Constant(INT8, [0] * LANES)))

    # odd quarters swap both
    is_odd = has_bit(quarter, 1)
    a, b = is_odd.select(sine, cosine), is_odd.select(cosine, sine)
    following = builder.add(quarter, ir.Constant(INT8, [1] * LANES))
    return has_bit(following, 2).select(a * -1.0, a), has_bit(quarter, 2).select(b * -1.0, b)


class _Rows:
    """Rows of eight doubles at an address, a number of bytes apart that is known when the code runs."""

    def __init__(self, builder: ir.IRBuilder, address: ir.Value, row_bytes: ir.Value) -> None:
        self.builder, self.address, self.row_bytes = builder, address, row_bytes

    def _row(self, row: int) -> VectorRows:
        offset = self.builder.mul(self.row_bytes, ir.Constant(I64, row))
        return VectorRows(self.builder, self.builder.add(self.address, offset), DOUBLE8)

    def __getitem__(self, row: int) -> Vector:
        return self._row(row)[0]

    def __setitem__(self, row: int, vector: Vector) -> None:
        self._row(row)[0] = vector
