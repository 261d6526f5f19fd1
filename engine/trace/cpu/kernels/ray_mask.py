"""Ray masks: the rays of a packet that may hit each candidate, as bits of one word, and the distances.

A ray is the point (a, b) where it passes the plane at distance one along the packet's axis. The outline of a
candidate's ellipse, seen from the packet's origin, lies between two values of a and two of b; the rays
between them are found by a table over bins of a and b.
"""

from collections.abc import Sequence

import llvmlite.ir as ir
import numpy as np
from jaxtyping import Float64, Int32, UInt64
from numba import types
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic

from octasplat.engine.core.compilation import device_function
from octasplat.engine.trace.cpu.kernels.kernel_args import RayArrays
from octasplat.engine.trace.cpu.kernels.rays import ray_slopes
from octasplat.engine.trace.cpu.kernels.simd_vector import (
    FLOAT8,
    I64,
    LANES,
    ROUNDING_MARGIN,
    Vector,
    VectorRows,
    broadcast,
    sum_abs,
)
from octasplat.engine.trace.kernels.native import Address, Intrinsic

BINS = 64
CELL_GRID = 8
CELLS = CELL_GRID * CELL_GRID
"""Cells of the pyramid's cross section along a Z-order curve."""
FRAME_WORDS = 15
"""A packet's axis, e and f; its slopes a low, a high, b low, b high; bins per slope along a and b."""


@device_function(error_model="numpy")
def write_ray_bins(
    rays: RayArrays,
    first: int,
    last: int,
    frame: Float64[np.ndarray, "15"],
    prefix_masks: UInt64[np.ndarray, "2 65"],
) -> None:
    """Write the bins per slope into the frame, and which rays lie in the bins before each.

    ``prefix_masks[axis, i]`` gets the bits of the rays in the bins before i.
    """
    frame[13] = BINS / (frame[10] - frame[9])
    frame[14] = BINS / (frame[12] - frame[11])
    prefix_masks[:] = 0
    for r in range(first, last):
        a, b, _per_axis = ray_slopes(rays, r, frame)
        bit = np.uint64(1) << np.uint64(r - first)
        for axis, slope in enumerate((a, b)):
            place = (slope - frame[9 + 2 * axis]) * frame[13 + axis]
            # one further on: row i gets the bins before i
            prefix_masks[axis, np.int64(min(max(place, 0.0), BINS - 1.0)) + 1] |= bit
    # running unions, so that any range of bins is a difference of two rows
    for i in range(BINS):
        prefix_masks[0, i + 1] |= prefix_masks[0, i]
        prefix_masks[1, i + 1] |= prefix_masks[1, i]


def _distances(
    m: Sequence[Vector], u: Sequence[Vector], v: Sequence[Vector], f: Sequence[Vector]
) -> tuple[Vector, Vector]:
    """Return the least distance at which rays can meet ellipses, and that at which most do.

    Args:
        m: their middles, from the packet's origin.
        u: one of their legs.
        v: the other.
        f: the packet's frame.
    """
    middle, u_axis, v_axis = dot(m, f[0:3]), dot(u, f[0:3]), dot(v, f[0:3])
    far, size = sum_abs(m), sum_abs([*u, *v])
    # The plane's depth along the axis is largest and least at the pyramid's edges, if it meets all four.
    n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    height, on_axis = dot(m, n), dot(n, f[0:3])
    on_e, on_f = dot(n, f[3:6]), dot(n, f[6:9])
    behind = height < 0.0
    height, on_axis, on_e, on_f = (behind.select(0.0 - term, term) for term in (height, on_axis, on_e, on_f))
    unsure = sum_abs(n) * ROUNDING_MARGIN
    steepest = on_axis + (f[9] * on_e).maximum(f[10] * on_e) + (f[11] * on_f).maximum(f[12] * on_f)
    steepest = steepest + unsure
    reach = (u_axis * u_axis + v_axis * v_axis).sqrt()
    near = middle - reach - (far + size) * ROUNDING_MARGIN  # near end of the ellipse along the axis
    least = (steepest > 0.0).select(near.maximum((height - far * unsure) / steepest), near)
    likely = (on_axis > 0.0).select(height / on_axis, middle)
    likely = likely.maximum(near).minimum(middle + reach)
    return least.maximum(0.0), likely.maximum(0.0)


@intrinsic
def ellipse_bins(
    typingctx: TypingContext,
    block: Address,
    frame: Address,
    ox: float,
    oy: float,
    oz: float,
    bins: Address,
    distances: Address,
) -> Intrinsic:
    """Write the bins and distances of the eight ellipses of a block of leaves, seen from o; all float32.

    Writes the first and last bin along a, then along b, as rows of eight int32 to ``bins``, and two rows to
    ``distances``: the least distance at which a ray of the packet can meet the ellipse, and that at which
    most do. Outlines are wider and least distances less by what rounding can do. An ellipse that reaches
    behind the origin is everywhere. Bit k of the result: octagon k has not vanished.
    """
    single, address = types.float32, types.uintp
    signature = types.int64(address, address, single, single, single, address, address)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        block, frame, ox, oy, oz, bins, distances = args
        rows = VectorRows(builder, block, FLOAT8)
        words = builder.inttoptr(frame, ir.FloatType().as_pointer())
        f = [
            broadcast(builder, builder.load(builder.gep(words, [ir.Constant(I64, k)])))
            for k in range(FRAME_WORDS)
        ]
        m = [rows[k] - broadcast(builder, o) for k, o in enumerate((ox, oy, oz))]
        u, v = [rows[3 + k] for k in range(3)], [rows[6 + k] for k in range(3)]
        middle, u_axis, v_axis = dot(m, f[0:3]), dot(u, f[0:3]), dot(v, f[0:3])
        depth2, reach2 = middle * middle, u_axis * u_axis + v_axis * v_axis
        # wholly in front of the origin, with room for rounding; else no bounds on its slopes exist
        in_front = (depth2 > reach2 * 1.1) & (middle > 0.0)
        per_middle = 1.0 / middle
        inverse = 1.0 / (depth2 - reach2)
        far, size = sum_abs(m), sum_abs([*u, *v])
        # What is off by a fraction of m or of the legs moves a slope by that over the depth, times the slope;
        # and the difference of squares passes on as often what is off in them.
        wide = (far + size * 2.0) * per_middle * (depth2 * inverse)
        room = wide * wide * ROUNDING_MARGIN + 1e-9
        out = VectorRows(builder, bins, ir.VectorType(ir.IntType(32), LANES))
        for axis in range(2):
            e = f[3 + 3 * axis : 6 + 3 * axis]
            # The outline touches slope s + d, s that of the centre, where
            # (u' - d u)^2 + (v' - d v)^2 = (d middle)^2 with u' = u.e - s u.
            centre = dot(m, e) * per_middle
            u_e, v_e = dot(u, e) - centre * u_axis, dot(v, e) - centre * v_axis
            b = u_e * u_axis + v_e * v_axis
            root = (b * b + (depth2 - reach2) * (u_e * u_e + v_e * v_e)).sqrt()
            low = centre - (b + root) * inverse - room
            high = centre + (root - b) * inverse + room
            start, scale = f[9 + 2 * axis], f[13 + axis]
            first, last = ((edge - start) * scale for edge in (low, high))
            first, last = in_front.select(first, 0.0), in_front.select(last, BINS - 1.0)
            out[2 * axis] = first.maximum(0.0).minimum(BINS - 1.0).to_int32()
            out[2 * axis + 1] = last.maximum(0.0).minimum(BINS - 1.0).to_int32()
        out = VectorRows(builder, distances, FLOAT8)
        out[0], out[1] = _distances(m, u, v, f)
        return (reach2 >= 0.0).to_bitmask()  # false for a vanished octagon, whose legs are not-a-number

    return signature, codegen


def dot(a: Sequence[Vector], b: Sequence[Vector]) -> Vector:
    """Return the dot product of two vectors with three components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device_function(error_model="numpy")
def rays_in_bins(
    bins: Int32[np.ndarray, "4 8"], lane: int, prefix_masks: UInt64[np.ndarray, "2 65"]
) -> tuple[int, int]:
    """Return bits of the rays in the bins of one lane, and the cell of their middle."""
    i0, i1, j0, j1 = bins[0, lane], bins[1, lane], bins[2, lane], bins[3, lane]
    mask = prefix_masks[0, i1 + 1] & ~prefix_masks[0, i0] & prefix_masks[1, j1 + 1] & ~prefix_masks[1, j0]
    # cell of the middle, its bits interleaved as a Z-order number
    i, j = (i0 + i1) * CELL_GRID // (2 * BINS), (j0 + j1) * CELL_GRID // (2 * BINS)
    cell = 0
    for bit in range(3):
        cell |= ((i >> bit) & 1) << (2 * bit) | ((j >> bit) & 1) << (2 * bit + 1)
    return mask, cell
