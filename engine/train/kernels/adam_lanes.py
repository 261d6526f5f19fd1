"""The step of Adam on vectors of sixteen float32, and on fewer numbers through a buffer."""

from collections.abc import Sequence

import llvmlite.ir as ir
from numba import types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.trace.kernels.native import Address, Intrinsic, float32_pointer, njit_no_refcount

LANES = 16


@intrinsic
def step_lanes(
    typingctx: TypingContext,
    values: Address,
    gradients: Address,
    rates: Address,
    first: Address,
    second: Address,
    numbers: tuple[float, ...],
) -> Intrinsic:
    """One step for sixteen float32 at each address, in float32.

    ``numbers`` are what both moments are multiplied by, both betas, one minus each, and epsilon.
    """
    address, single = types.uintp, types.float32
    signature = types.void(*(address,) * 5, types.UniTuple(single, 7))

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        *places, numbers = args
        kind = ir.VectorType(ir.FloatType(), LANES)
        lanes = ir.VectorType(ir.IntType(32), LANES)
        root = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(kind, [kind]), f"llvm.sqrt.v{LANES}f32"
        )

        def everywhere(scalar: ir.Value, vector: ir.Type) -> ir.Value:
            one = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, _word(0))
            return builder.shuffle_vector(
                one, ir.Constant(vector, ir.Undefined), ir.Constant(lanes, [0] * LANES)
            )

        def times(a: ir.Value, b: ir.Value) -> ir.Value:
            return builder.fmul(a, b, flags=("contract",))

        numbers = [everywhere(number, kind) for number in cgutils.unpack_tuple(builder, numbers)]
        correction1, correction2, beta1, beta2, rest1, rest2, epsilon = numbers
        places = [builder.inttoptr(place, kind.as_pointer()) for place in places]
        value, gradient, rate, m, v = (builder.load(at, align=4) for at in places)
        m = builder.fadd(times(beta1, m), times(rest1, gradient), flags=("contract",))
        v = builder.fadd(times(beta2, v), times(times(rest2, gradient), gradient), flags=("contract",))
        # m and v without the bias of their zero start
        below = builder.fadd(builder.call(root, [times(v, correction2)]), epsilon)
        step = builder.fdiv(times(rate, times(m, correction1)), below)
        for found, at in ((builder.fsub(value, step), 0), (m, 3), (v, 4)):
            builder.store(found, places[at], align=4)
        return context.get_dummy_value()

    return signature, codegen


def _word(value: int) -> ir.Value:
    return ir.Constant(ir.IntType(32), value)


@njit_no_refcount()
def copy_few(source: Address, target: Address, count: int) -> None:
    """Copy so many float32 from one address to another."""
    read, write = float32_pointer(source), float32_pointer(target)
    for k in range(count):
        write[k] = read[k]


@njit_no_refcount()
def step_few(
    values: Address,
    gradients: Address,
    rates: Address,
    first: Address,
    second: Address,
    count: int,
    room: Address,
    numbers: tuple[float, ...],
) -> None:
    """:func:`step_lanes` for the first ``count`` alone, within ``room`` for 64 float32.

    Storing some lanes of a vector is slow on processors with AVX2 alone.
    """
    line = LANES * 4
    copy_few(values, room, count)
    copy_few(gradients, room + line, count)
    copy_few(first, room + 2 * line, count)
    copy_few(second, room + 3 * line, count)
    step_lanes(room, room + line, rates, room + 2 * line, room + 3 * line, numbers)
    copy_few(room, values, count)
    copy_few(room + 2 * line, first, count)
    copy_few(room + 3 * line, second, count)
