"""All sixteen harmonics of three channels at a time, four harmonics to a vector of twelve float32."""

from collections.abc import Sequence

import llvmlite.ir as ir
from numba import types
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.trace.cpu.kernels.simd_vector import DOUBLE8, FLOAT8, I64, Vector, VectorRows
from octasplat.engine.trace.kernels.native import Address, Intrinsic

HARMONICS, CHANNELS = 16, 3
SH_VECTORS = 4
"""Vectors of four harmonics."""
FLOAT, DOUBLE, I32 = ir.FloatType(), ir.DoubleType(), ir.IntType(32)
FLOAT12, FLOAT4, DOUBLE4 = (ir.VectorType(kind, n) for kind, n in ((FLOAT, 12), (FLOAT, 4), (DOUBLE, 4)))


def _shuffle_mask(lanes: list[int]) -> ir.Value:
    return ir.Constant(ir.VectorType(I32, len(lanes)), lanes)


def _shuffle(builder: ir.IRBuilder, vector: ir.Value, lanes: list[int]) -> ir.Value:
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), _shuffle_mask(lanes))


def _load_basis(builder: ir.IRBuilder, basis: ir.Value) -> list[Vector]:
    """Load sixteen doubles as four vectors in which each is repeated three times."""
    rows = VectorRows(builder, basis, DOUBLE8)
    low, high = (builder.fptrunc(rows[k].value, FLOAT8) for k in range(2))
    whole = builder.shuffle_vector(low, high, _shuffle_mask(list(range(HARMONICS))))
    return [
        Vector(builder, _shuffle(builder, whole, [4 * four + k // CHANNELS for k in range(12)]))
        for four in range(SH_VECTORS)
    ]


def _tile_channels(builder: ir.IRBuilder, rgb: Sequence[ir.Value]) -> Vector:
    """Return three doubles, repeated four times."""
    vector = ir.Constant(FLOAT4, [0.0] * 4)
    for channel, value in enumerate(rgb):
        vector = builder.insert_element(vector, builder.fptrunc(value, FLOAT), ir.Constant(I32, channel))
    return Vector(builder, _shuffle(builder, vector, list(range(CHANNELS)) * 4))


@intrinsic
def eval_sh16(typingctx: TypingContext, sh: Address, basis: Address) -> Intrinsic:
    """Sum over the harmonics of ``sh`` (16 x 3 float32) times ``basis`` (16 doubles), three doubles."""
    signature = types.UniTuple(types.float64, CHANNELS)(types.uintp, types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        rows, basis = VectorRows(builder, args[0], FLOAT12), _load_basis(builder, args[1])
        total = rows[0] * basis[0]
        for four in range(1, SH_VECTORS):
            total = rows[four] * basis[four] + total
        parts = [
            Vector(builder, _shuffle(builder, total.value, [first, first + 1, first + 2, first]))
            for first in range(0, 12, CHANNELS)
            # lanes are r, g, b of four harmonics in turn: add the four
        ]
        found = parts[0] + parts[1] + parts[2] + parts[3]
        values = [
            builder.fpext(builder.extract_element(found.value, ir.Constant(I32, k)), DOUBLE)
            for k in range(CHANNELS)
        ]
        return context.make_tuple(builder, sig.return_type, values)

    return signature, codegen


@intrinsic
def accumulate_sh16(
    typingctx: TypingContext, sh: Address, basis: Address, red: float, green: float, blue: float
) -> Intrinsic:
    """Add to ``sh`` (16 x 3 float32) the ``basis`` (16 doubles) times three channels."""
    signature = types.void(types.uintp, types.uintp, *(types.float64,) * CHANNELS)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        rows, channels = VectorRows(builder, args[0], FLOAT12), _tile_channels(builder, args[2:])
        for four, harmonic in enumerate(_load_basis(builder, args[1])):
            rows[four] = harmonic * channels + rows[four]
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def write_basis_gradient16(
    typingctx: TypingContext, values: Address, sh: Address, red: float, green: float, blue: float
) -> Intrinsic:
    """Write the sums over three channels of ``sh`` (16 x 3 float32) times those, sixteen doubles."""
    signature = types.void(types.uintp, types.uintp, *(types.float64,) * CHANNELS)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        rows, channels = VectorRows(builder, args[1], FLOAT12), _tile_channels(builder, args[2:])
        for four in range(SH_VECTORS):
            product = (rows[four] * channels).value
            a, b, c = (
                Vector(builder, _shuffle(builder, product, list(range(k, 12, CHANNELS))))
                for k in range(CHANNELS)
            )
            at = builder.add(args[0], ir.Constant(I64, 32 * four))
            VectorRows(builder, at, DOUBLE4)[0] = Vector(builder, builder.fpext((a + b + c).value, DOUBLE4))
        return context.get_dummy_value()

    return signature, codegen
