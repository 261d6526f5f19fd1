"""Points of surfaces that rays meet, of eight rays at a time: place, normals and the cosine to the viewer.

A root and a division follow each other twice in it; one ray alone spends most of its time waiting for them.
"""

from collections.abc import Sequence

import llvmlite.ir as ir
from numba import types
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.pathtracing.kernels.surface import FACE_OFFSET_SCALE, RAY_OFFSET_SCALE
from octasplat.engine.trace.cpu.kernels.simd_ops import INT8, LONG8, gather, load, store
from octasplat.engine.trace.cpu.kernels.simd_vector import DOUBLE8, FLOAT8, LANES, Vector
from octasplat.engine.trace.kernels.native import Address, Intrinsic

SURFACE_POINT_ROWS = 11
"""Rows of a block of surface points: place, normal, shading normal, cosine to the viewer, and how far off the
surface rays begin."""
RAY_STEP_ROW = 10
_VectorXyz = list[Vector]


def _largest(values: _VectorXyz) -> Vector:
    largest = abs(values[0])
    for value in values[1:]:
        largest = largest.maximum(abs(value))
    return largest


def _dot(a: _VectorXyz, b: _VectorXyz) -> Vector:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: _VectorXyz, b: _VectorXyz) -> _VectorXyz:
    return [a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3] for k in range(3)]


def _normalize(a: _VectorXyz) -> _VectorXyz:
    inverse = 1.0 / _dot(a, a).sqrt().maximum(1e-30)
    return [x * inverse for x in a]


@intrinsic
def write_surface_points8(
    typingctx: TypingContext,
    rows: Address,
    active: Address,
    faces: Address,
    barycentrics: Address,
    directions: Address,
    corners: Address,
    normals: Address,
    out: Address,
    out_row_bytes: int,
) -> Intrinsic:
    """Write the surface points of eight rows of hits, in :data:`SURFACE_POINT_ROWS` rows of doubles.

    All but the last are addresses: of eight ``rows``, each of which has a path in ``active``, a face and its
    barycentrics; of the directions of all paths; and of the corners of all faces and their normals.
    """
    signature = types.void(*[types.uintp] * 8, types.int64)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        def items(address: ir.Value, indices: ir.Value, width: int) -> list[Vector]:
            """Return the ``width`` float32 of each of the rows of an array, as doubles."""
            firsts = builder.mul(indices, ir.Constant(LONG8, [width] * LANES))
            return [
                Vector(
                    builder,
                    gather(builder, address, builder.add(firsts, ir.Constant(LONG8, [j] * LANES)), FLOAT8),
                ).to_float64()
                for j in range(width)
            ]

        k = builder.sext(load(builder, args[0], INT8), LONG8)
        paths = builder.sext(gather(builder, args[1], k, INT8), LONG8)
        face = builder.sext(gather(builder, args[2], k, INT8), LONG8)
        b, c = items(args[3], k, 2)
        a = 1.0 - b - c
        d = items(args[4], paths, 3)
        corner, corner_normal = items(args[5], face, 9), items(args[6], face, 9)
        # --- the face's normal, on the viewer's side ---
        edges = [[corner[first + j] - corner[j] for j in range(3)] for first in (3, 6)]
        n = _normalize(_cross(*edges))
        facing = _dot(d, n) * -1.0
        side = (facing >= 0.0).select(Vector(builder, ir.Constant(DOUBLE8, [1.0] * LANES)), -1.0)
        n = [x * side for x in n]
        # --- the interpolated normal on the same side; the face's where the viewer sees that from behind ---
        place, s = (
            [a * rows[j] + b * rows[3 + j] + c * rows[6 + j] for j in range(3)]
            for rows in (corner, corner_normal)
        )
        s = _normalize(s)
        is_below = _dot(s, n) < 0.0
        s = [is_below.select(x * -1.0, x) for x in s]
        is_hidden = _dot(s, d) > -1e-4
        s = [is_hidden.select(x, y) for x, y in zip(n, s, strict=True)]
        # --- how far off the surface rays begin ---
        step = _largest(place).maximum(1e-3) * RAY_OFFSET_SCALE
        step = step.maximum(_largest([x for edge in edges for x in edge]) * FACE_OFFSET_SCALE)
        for j, value in enumerate([*place, *n, *s, facing, step]):
            address = builder.add(args[7], builder.mul(args[8], ir.Constant(args[8].type, j)))
            store(builder, value.value, address)
        return context.get_dummy_value()

    return signature, codegen
