"""The numbers of :mod:`octasplat.engine.pathtracing.kernels.sampler`, of eight paths at a time.

Loop vectorisers leave the hashes scalar where the processor has no AVX-512. Here they are explicit vectors of
integers, so that the results are the very bits of the scalar functions.
"""

from collections.abc import Sequence

import llvmlite.ir as ir
from numba import types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.trace.kernels.native import Address, Intrinsic

LANES = 8
_I32 = ir.IntType(32)
_UINT8 = ir.VectorType(_I32, LANES)
_DOUBLE8 = ir.VectorType(ir.DoubleType(), LANES)
_LARGEST = 0xFFFFFF00  # over 2^32 it is the largest float32 below 1


class _Words:
    """Eight lanes of 32 bits, with the operators of the hashes; numbers stand for all lanes."""

    def __init__(self, builder: ir.IRBuilder, value: ir.Value) -> None:
        self.builder, self.value = builder, value

    def _operand(self, other: "_Words | int") -> ir.Value:
        return other.value if isinstance(other, _Words) else ir.Constant(_UINT8, [other] * LANES)

    def __add__(self, other: "_Words | int") -> "_Words":
        return _Words(self.builder, self.builder.add(self.value, self._operand(other)))

    def __mul__(self, other: "_Words | int") -> "_Words":
        return _Words(self.builder, self.builder.mul(self.value, self._operand(other)))

    def __xor__(self, other: "_Words | int") -> "_Words":
        return _Words(self.builder, self.builder.xor(self.value, self._operand(other)))

    def __and__(self, other: "_Words | int") -> "_Words":
        return _Words(self.builder, self.builder.and_(self.value, self._operand(other)))

    def __rshift__(self, other: "_Words | int") -> "_Words":
        return _Words(self.builder, self.builder.lshr(self.value, self._operand(other)))

    def __lshift__(self, other: "_Words | int") -> "_Words":
        return _Words(self.builder, self.builder.shl(self.value, self._operand(other)))

    def reversed_bits(self) -> "_Words":
        """Return the bits of each lane in the opposite order."""
        name = f"llvm.bitreverse.v{LANES}i32"
        function = cgutils.get_or_insert_function(
            self.builder.module, ir.FunctionType(_UINT8, [_UINT8]), name
        )
        return _Words(self.builder, self.builder.call(function, [self.value]))

    def to_unit(self) -> ir.Value:
        """Return the lanes over 2^32 as doubles, below 1 in float32 as well."""
        largest = ir.Constant(_UINT8, [_LARGEST] * LANES)
        too_large = self.builder.icmp_unsigned(">", self.value, largest)
        limited = self.builder.select(too_large, largest, self.value)
        doubles = self.builder.uitofp(limited, _DOUBLE8)
        return self.builder.fmul(doubles, ir.Constant(_DOUBLE8, [2.0**-32] * LANES))


def _hash(x: _Words) -> _Words:
    """See :func:`octasplat.engine.pathtracing.kernels.sampler.hash_uint32`."""
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


def _permute(x: _Words, seed: _Words) -> _Words:
    """Permute bits as Laine and Karras do; see the module of the scalar functions."""
    x = x + seed
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x = x ^ (x * factor)
    return x


@intrinsic
def write_uniform_pairs8(
    typingctx: TypingContext,
    keys: Address,
    samples: Address,
    pair_number: int,
    first: Address,
    second: Address,
) -> Intrinsic:
    """Write :func:`octasplat.engine.pathtracing.kernels.sampler.uniform_pair` of eight paths.

    ``keys`` and ``samples`` are the addresses of eight words each, ``first`` and ``second`` of eight doubles;
    ``pair_number`` counts the pairs of dimensions from 1.
    """
    signature = types.void(types.uintp, types.uintp, types.uint32, types.uintp, types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        def load(address: ir.Value) -> _Words:
            return _Words(builder, builder.load(builder.inttoptr(address, _UINT8.as_pointer()), align=4))

        lane = builder.insert_element(ir.Constant(_UINT8, ir.Undefined), args[2], ir.Constant(_I32, 0))
        places = ir.Constant(_UINT8, [0] * LANES)
        pairs = _Words(builder, builder.shuffle_vector(lane, ir.Constant(_UINT8, ir.Undefined), places))
        seed = _hash(load(args[0]) + pairs * 0x85EBCA6B)
        order = _permute((load(args[1]) << 16).reversed_bits(), seed)
        index = order.reversed_bits() >> 16
        # Sobol's second dimension, see ``sobol_reversed_bits``
        other = index
        for bits, step in ((0xFF00FF00, 8), (0xF0F0F0F0, 4), (0xCCCCCCCC, 2), (0xAAAAAAAA, 1)):
            other = other ^ ((other & bits) >> step)
        for digits, salt, address in ((index, 0x68E31DA4, args[3]), (other, 0xB5297A4D, args[4])):
            number = _permute(digits, _hash(seed ^ salt)).reversed_bits().to_unit()
            builder.store(number, builder.inttoptr(address, _DOUBLE8.as_pointer()), align=8)
        return context.get_dummy_value()

    return signature, codegen
