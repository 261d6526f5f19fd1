"""Numba's tools: kernels that count no references, raw memory, native functions, and a shared counter."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, TypeAlias

import llvmlite.ir as ir
from numba import cfunc, types
from numba.core import cgutils
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.core.compilation import device_function

Address: TypeAlias = int
"""An address in memory, numba's ``uintp``."""
Intrinsic: TypeAlias = tuple[
    Signature, Callable[[BaseContext, ir.IRBuilder, Signature, Sequence[ir.Value]], ir.Value]
]
"""What a function marked ``@intrinsic`` returns: the types of a call, and what writes its code.

Its parameters are annotated with the values that kernels pass. The function itself is given their numba
types.
"""
CACHE_LINE_BYTES = 64
"""Bytes of a cache line."""


def njit_no_refcount(**options: Any) -> Callable[[Any], Any]:
    """Return :func:`device_function` for functions that make no arrays: no references are counted.

    Else every use of a field of a named tuple counts one up and down again, one by one for all threads, which
    takes longer than the work of a hit.
    """
    return device_function(_nrt=False, error_model="numpy", **options)


class NativeCallback:
    """A function that native code calls; it is compiled when its address is first asked for.

    Args:
        function: takes what ``signature`` says.
        signature: numba's.
        options: as of ``numba.cfunc``.
    """

    def __init__(self, function: Callable[..., None], signature: Signature, options: dict[str, Any]) -> None:
        self.function = function
        self._signature = signature
        self._options = options

    def compile(self) -> Any:
        """Return the compiled function; its code is kept on the disk."""
        return cfunc(self._signature, cache=True, **self._options)(self.function)

    @cached_property
    def _compiled(self) -> Any:
        return self.compile()

    @property
    def address(self) -> Address:
        """Return the callback's address, valid while this object lives."""
        return int(self._compiled.address)


def native_callback(signature: Signature, **options: Any) -> Callable[[Callable[..., None]], NativeCallback]:
    """Return a decorator that makes a :class:`NativeCallback`; options as of ``numba.cfunc``."""
    return lambda function: NativeCallback(function, signature, options)


def _pointer_cast(element: types.Type) -> Any:
    @intrinsic
    def cast(typingctx: TypingContext, address: Address) -> Intrinsic:
        signature = types.CPointer(element)(types.uintp)

        def codegen(
            context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
        ) -> ir.Value:
            return builder.inttoptr(args[0], context.get_value_type(sig.return_type))

        return signature, codegen

    return cast


int32_pointer = _pointer_cast(types.int32)
float32_pointer = _pointer_cast(types.float32)
float64_pointer = _pointer_cast(types.float64)
uint64_pointer = _pointer_cast(types.uint64)


def _call_address(
    context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
) -> ir.Value:
    """Call the address ``args[0]`` with the others as pointers."""
    pointer = ir.IntType(8).as_pointer()
    function_type = ir.FunctionType(ir.VoidType(), [pointer] * (len(args) - 1))
    address = builder.inttoptr(args[0], function_type.as_pointer())
    builder.call(address, [builder.inttoptr(argument, pointer) for argument in args[1:]])
    return context.get_dummy_value()


@intrinsic
def call_with_three_pointers(
    typingctx: TypingContext, function: Address, first: Address, second: Address, third: Address
) -> Intrinsic:
    """Call ``void function(void*, void*, void*)`` at a run-time address."""
    signature = types.void(types.uintp, types.uintp, types.uintp, types.uintp)
    return signature, _call_address


@intrinsic
def call_with_four_pointers(
    typingctx: TypingContext,
    function: Address,
    first: Address,
    second: Address,
    third: Address,
    fourth: Address,
) -> Intrinsic:
    """Call ``void function(void*, void*, void*, void*)`` at a run-time address."""
    signature = types.void(types.uintp, types.uintp, types.uintp, types.uintp, types.uintp)
    return signature, _call_address


@intrinsic
def atomic_fetch_add(typingctx: TypingContext, address: Address, count: int) -> Intrinsic:
    """Add ``count`` to the int64 at ``address`` as one indivisible step and return its value before.

    Threads take their chunks of work from such a counter, so that none waits while there is work left.
    """
    signature = types.int64(types.uintp, types.int64)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        pointer = builder.inttoptr(args[0], ir.IntType(64).as_pointer())
        # only the numbers must differ: no other memory is ordered by them
        return builder.atomic_rmw("add", pointer, args[1], "monotonic")

    return signature, codegen


@njit_no_refcount(forceinline=True)
def atomic_fetch_next(address: int) -> int:
    """Increment the integer at ``address`` atomically and return its former value."""
    return atomic_fetch_add(address, 1)


@intrinsic
def prefetch(typingctx: TypingContext, address: Address) -> Intrinsic:
    """Prefetch the cache line at ``address``, which is read some dozen operations later."""
    signature = types.void(types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        pointer = ir.IntType(8).as_pointer()
        i32 = ir.IntType(32)
        function_type = ir.FunctionType(ir.VoidType(), [pointer, i32, i32, i32])
        function = cgutils.get_or_insert_function(builder.module, function_type, "llvm.prefetch.p0")
        # to be read, kept in all levels of the data cache
        hint = [ir.Constant(i32, 0), ir.Constant(i32, 3), ir.Constant(i32, 1)]
        builder.call(function, [builder.inttoptr(args[0], pointer), *hint])
        return context.get_dummy_value()

    return signature, codegen


@intrinsic
def fill_bytes(typingctx: TypingContext, address: Address, size: int, value: int) -> Intrinsic:
    """Set ``size`` bytes from ``address`` on to ``value``."""
    signature = types.void(types.uintp, types.int64, types.int64)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        pointer = builder.inttoptr(args[0], ir.IntType(8).as_pointer())
        cgutils.memset(builder, pointer, args[1], builder.trunc(args[2], ir.IntType(8)))
        return context.get_dummy_value()

    return signature, codegen


@njit_no_refcount(forceinline=True)
def prefetch_bytes(address: int, size: int) -> None:
    """Run :func:`prefetch` for all cache lines of so many bytes."""
    for line in range(address // CACHE_LINE_BYTES * CACHE_LINE_BYTES, address + size, CACHE_LINE_BYTES):
        prefetch(line)
