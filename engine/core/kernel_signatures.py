"""Argument types of kernels as text, so that a kernel can be compiled before anything calls it."""

import importlib
from collections.abc import Sequence
from typing import Any

import numba.core.types

types: Any = numba.core.types  # whose stubs lack half of it
EncodedType = str | dict[str, Any]


def encode_type(value: Any) -> EncodedType:
    """Return the JSON value of a numba type of a kernel's argument.

    >>> encode_type(types.Array(types.float32, 2, "C", readonly=True))
    'float32 2C readonly'
    >>> encode_type(types.UniTuple(types.int64, 2))
    {'items': ['int64', 'int64']}

    Raises:
        TypeError: no kernel takes such arguments.
    """
    if isinstance(value, types.Array):
        text = f"{value.dtype} {value.ndim}{value.layout}"
        return text if value.mutable else f"{text} readonly"
    if isinstance(value, types.BaseTuple):
        items = [encode_type(item) for item in value.types]
        name = getattr(value, "instance_class", None)
        return (
            {"items": items} if name is None else {"class": [name.__module__, name.__name__], "items": items}
        )
    if isinstance(value, types.Integer | types.Float | types.Boolean | types.NoneType):
        return str(value)
    raise TypeError(f"no kernel takes arguments of the type {value}")


def decode_type(value: EncodedType) -> Any:
    """Return the numba type that :func:`encode_type` wrote.

    >>> decode_type("float32 2C readonly")
    Array(float32, 2, 'C', True, aligned=True)
    >>> decode_type({"items": ["int64", "int64"]})
    UniTuple(int64, 2)
    """
    if isinstance(value, dict):
        items = tuple(decode_type(item) for item in value["items"])
        if "class" not in value:
            return types.BaseTuple.from_types(items)
        module, name = value["class"]
        return types.BaseTuple.from_types(items, getattr(importlib.import_module(module), name))
    name, _, shape = value.partition(" ")
    scalar = getattr(types, name)
    if not shape:
        return scalar
    shape, _, mark = shape.partition(" ")
    return types.Array(scalar, int(shape[:-1]), shape[-1], readonly=mark == "readonly")


def compile_kernel(module: str, function: str, arguments: Sequence[EncodedType], *, skip_busy: bool) -> bool:
    """Compile a kernel for these arguments unless its code is kept already.

    Args:
        module: of the kernel.
        function: its name.
        arguments: encoded types; none of a callback of native code.
        skip_busy: do nothing while another process compiles it.

    Returns:
        Whether the code is there now.
    """
    dispatcher = getattr(importlib.import_module(module), function)
    if not hasattr(dispatcher, "_cache"):  # a callback of native code, whose types are its own
        dispatcher.compile()
        return True
    if skip_busy and dispatcher._cache.is_being_compiled():
        return False
    dispatcher.compile(tuple(map(decode_type, arguments)))
    return True
