"""Operations on vectors of eight lanes: constants, lane moves, and loads and stores by address."""

from collections.abc import Callable

import llvmlite.ir as ir
from numba.core import cgutils
from numba.core.base import BaseContext

from octasplat.engine.trace.cpu.kernels.simd_vector import DOUBLE8, FLOAT8, I64, LANES, Vector

I1, I32 = ir.IntType(1), ir.IntType(32)
FLOAT, DOUBLE = ir.FloatType(), ir.DoubleType()
INT8, MASK8 = ir.VectorType(I32, LANES), ir.VectorType(I1, LANES)
LONG8 = ir.VectorType(I64, LANES)


def prefix_scan(
    builder: ir.IRBuilder,
    vector: Vector,
    combine: Callable[[Vector, Vector], Vector],
    neutral: float,
    reverse: bool = False,
) -> Vector:
    """Combine each lane with all before it, or behind it, in three steps."""
    for step in (1, 2, 4):
        vector = combine(vector, shift_lanes(builder, vector, -step if reverse else step, neutral))
    return vector


def shift_lanes(builder: ir.IRBuilder, vector: Vector, offset_lanes: int, fill_value: float) -> Vector:
    """Move lane k to lane k + ``offset_lanes``; ``fill_value`` enters."""
    fill = ir.Constant(vector.value.type, [float(fill_value)] * LANES)
    # LANES names the first lane of the fill
    places = [k - offset_lanes if 0 <= k - offset_lanes < LANES else LANES for k in range(LANES)]
    order = ir.Constant(ir.VectorType(I32, LANES), places)
    return Vector(builder, builder.shuffle_vector(vector.value, fill, order))


def splat(builder: ir.IRBuilder, scalar: ir.Value, kind: ir.Type) -> ir.Value:
    """Return a vector of eight times ``scalar``."""
    vector = ir.VectorType(kind, LANES)
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(I32, 0))
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), ir.Constant(INT8, [0] * LANES))


def keep_first_lanes(builder: ir.IRBuilder, vector: Vector, count: ir.Value) -> Vector:
    """Return the first ``count`` lanes; zero in the others."""
    valid = first_lanes_mask(builder, count)
    return Vector(builder, builder.select(valid, vector.value, ir.Constant(vector.value.type, [0.0] * LANES)))


def first_lanes_mask(builder: ir.IRBuilder, count: ir.Value) -> ir.Value:
    """Return truth for the first ``count`` lanes."""
    lanes = ir.Constant(LONG8, list(range(LANES)))
    return builder.icmp_signed("<", lanes, splat(builder, count, I64))


def key_indices(builder: ir.IRBuilder, key: ir.Value, valid: ir.Value) -> ir.Value:
    """Return the lower halves of the keys, 0 where they are not valid."""
    # invalid lanes may hold anything: index 0 keeps their gather inside the array
    lower = builder.and_(key, ir.Constant(LONG8, [0xFFFFFFFF] * LANES))
    return builder.select(valid, lower, ir.Constant(LONG8, [0] * LANES))


def key_distances(builder: ir.IRBuilder, key: ir.Value) -> ir.Value:
    """Return the upper halves of the keys, float32."""
    upper = builder.lshr(key, ir.Constant(LONG8, [32] * LANES))
    return builder.bitcast(builder.trunc(upper, INT8), FLOAT8)


def gather(builder: ir.IRBuilder, address: ir.Value, indices: ir.Value, kind: ir.Type) -> ir.Value:
    """Gather eight elements of ``kind`` at indices of an array."""
    element = kind.element
    size, name = {FLOAT: (4, "f32"), DOUBLE: (8, "f64"), I32: (4, "i32")}[element]
    pointers = ir.VectorType(ir.IntType(8).as_pointer(), LANES)
    indices = builder.mul(indices, ir.Constant(LONG8, [size] * LANES))
    where = builder.inttoptr(builder.add(indices, splat(builder, address, I64)), pointers)
    function_type = ir.FunctionType(kind, [pointers, I32, MASK8, kind])
    function = cgutils.get_or_insert_function(
        builder.module, function_type, f"llvm.masked.gather.v8{name}.v8p0"
    )
    mask = ir.Constant(MASK8, [1] * LANES)
    return builder.call(function, [where, ir.Constant(I32, 4), mask, ir.Constant(kind, ir.Undefined)])


def load(builder: ir.IRBuilder, address: ir.Value, kind: ir.Type) -> ir.Value:
    """Return a vector of that kind from an address."""
    # rows of arrays are aligned to their elements only
    return builder.load(builder.inttoptr(address, kind.as_pointer()), align=4)


def has_avx2_permute(context: BaseContext) -> bool:
    """Return whether lanes without gaps are to be made by AVX2's moves, see :class:`CompressedStore`."""
    features = context.codegen().magic_tuple()[2].split(",")
    return "+avx2" in features and "+avx512f" not in features


class CompressedStore:
    """Stores the lanes of a mask without gaps, in order; what follows them is undefined.

    AVX-512 has an instruction for that. AVX2 has none, and what a compiler makes up are some fifty; but it
    moves lanes of 32 bits to wherever a vector says, and there is room for such a vector for each of the 256
    masks.
    """

    def __init__(self, context: BaseContext, builder: ir.IRBuilder, mask: ir.Value) -> None:
        self.builder, self.mask = builder, mask
        self.bits = builder.zext(builder.bitcast(mask, ir.IntType(LANES)), I64)
        self.use_permute = has_avx2_permute(context)
        if self.use_permute:
            self.permutation = self._load_permutation(8, self.bits)
            self.low_bits = builder.and_(self.bits, ir.Constant(I64, 15))
            self.high_bits = builder.lshr(self.bits, ir.Constant(I64, 4))

    def count(self) -> ir.Value:
        """Return how many lanes there are in the mask."""
        return self.builder.ctpop(self.bits)

    def compress(self, value: ir.Value) -> ir.Value:
        """Compress eight lanes of 32 bits by the mask, without gaps."""
        if not self.use_permute:
            return self._compress_avx512(value)
        return self._permute(value, self.permutation)

    def compress_store(self, value: ir.Value, address: ir.Value) -> None:
        """Store eight lanes of 32 or 64 bits."""
        builder = self.builder
        if not self.use_permute or value.type.element is not DOUBLE:
            store(builder, self.compress(value), address)
            return
        four = ir.VectorType(DOUBLE, 4)
        # four doubles at a time: AVX2 has no 64-bit permutation by a vector of lanes
        for first, bits in ((0, self.low_bits), (4, self.high_bits)):
            half = builder.shuffle_vector(
                value, ir.Constant(DOUBLE8, ir.Undefined),
                ir.Constant(ir.VectorType(I32, 4), list(range(first, first + 4))),
            )  # fmt: skip
            moved = self._permute(builder.bitcast(half, INT8), self._load_permutation(4, bits))
            store(builder, builder.bitcast(moved, four), address)
            address = element_address(builder, address, builder.ctpop(bits), 8)

    def _compress_avx512(self, value: ir.Value) -> ir.Value:
        element = {FLOAT: "f32", DOUBLE: "f64", I32: "i32"}[value.type.element]
        kind = ir.FunctionType(value.type, [value.type, MASK8, value.type])
        function = cgutils.get_or_insert_function(
            self.builder.module, kind, f"llvm.experimental.vector.compress.v8{element}"
        )
        return self.builder.call(function, [value, self.mask, ir.Constant(value.type, ir.Undefined)])

    def _permute(self, value: ir.Value, permutation: ir.Value) -> ir.Value:
        builder = self.builder
        kind = ir.FunctionType(INT8, [INT8, INT8])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx2.permd")
        moved = builder.call(function, [builder.bitcast(value, INT8), permutation])
        return builder.bitcast(moved, value.type)

    def _load_permutation(self, lanes: int, bits: ir.Value) -> ir.Value:
        """Return where each lane comes from, from a table over the masks of so many lanes."""
        builder, words = self.builder, LANES // lanes
        rows = []
        for mask in range(1 << lanes):
            chosen = [k for k in range(lanes) if mask >> k & 1]
            chosen += [0] * (lanes - len(chosen))
            rows.append(ir.Constant(INT8, [words * k + word for k in chosen for word in range(words)]))
        table = ir.Constant(ir.ArrayType(INT8, len(rows)), rows)
        at = cgutils.global_constant(builder.module, f"gapless.{lanes}", table)
        return builder.load(builder.gep(at, [ir.Constant(I64, 0), bits]), align=4)


def element_address(builder: ir.IRBuilder, address: ir.Value, index: ir.Value, size: int) -> ir.Value:
    """Return the address of an element of an array."""
    return builder.add(address, builder.mul(index, ir.Constant(I64, size)))


def store(builder: ir.IRBuilder, value: ir.Value, address: ir.Value) -> None:
    """Store a vector at an address."""
    builder.store(value, builder.inttoptr(address, value.type.as_pointer()), align=4)
