"""Eight points at a time: unit vectors to vertices, angles of edges, and sums over the triangles of a mesh.

Of an edge no more is needed than its angle over the sine of it, once for the two triangles beside it: that
is a polynomial of the cosine unless the angle is wide. What is rare goes a slower way: wide angles, and
points in the plane of a triangle.
"""

import math
from collections.abc import Callable, Sequence

import llvmlite.ir as ir
import numpy as np
from jaxtyping import Float64
from numba import types
from numba.core.base import BaseContext
from numba.core.typing import Context as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import intrinsic
from numpy.polynomial import Chebyshev, Polynomial

from octasplat.engine.trace.cpu.kernels.simd_vector import DOUBLE8, Vector, VectorRows, broadcast
from octasplat.engine.trace.kernels.native import Address, Intrinsic

FLAT_TOLERANCE = 1e-9
"""A point lies in the plane of a triangle if its unit vectors to the corners span less than this, as a share
of what those to the last two do."""
TINY_LENGTH = 1e-300
TURN = 2.0 * math.pi
TURN_TOLERANCE = 1e-6
"""Radians that the corners' angles may lack of a full turn where a point lies on a triangle."""
STEEP_LIMIT = math.tan(math.pi / 8)
WIDE_ANGLE = 0.25
"""Angles whose cosine is below this are wide."""
POINT_ROWS, VERTEX_ROWS = 3, 4
"""Rows of eight lanes that are kept: of points their place, of vertices the unit vector to them and one over
their distance. Of edges it is half the angle that they are seen under over its sine."""
INVERSE_DISTANCE = 3
"""Which of a vertex's rows is one over its distance."""


def _arctangent(squared: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    root = np.sqrt(np.maximum(squared, TINY_LENGTH))
    return np.arctan(root) / root


def _half_angle_over_sine(missing: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    # By half the angle, whose sine is known to all digits.
    half = np.arcsin(np.sqrt(np.maximum(missing, TINY_LENGTH) / 2))
    return half / np.sin(2 * half)


def _fit_polynomial(
    function: Callable[[Float64[np.ndarray, " n"]], Float64[np.ndarray, " n"]], degree: int, end: float
) -> list[float]:
    """Return the coefficients of a polynomial that fits a function from 0 to ``end`` to rounding."""
    fitted = Chebyshev.interpolate(function, degree, domain=[0.0, end])
    return [float(value) for value in fitted.convert(kind=Polynomial).coef]


ARCTANGENT = _fit_polynomial(_arctangent, 12, STEEP_LIMIT**2)
"""Coefficients of p in arctan(z) = z p(z^2), up to z = tan(pi / 8)."""
NARROW = _fit_polynomial(_half_angle_over_sine, 17, 1.0 - WIDE_ANGLE)
"""Of half an angle over its sine, by what its cosine lacks of 1."""


def _polynomial(coefficients: Sequence[float], x: Vector) -> Vector:
    value = x * coefficients[-1] + coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        value = value * x + coefficient
    return value


def _angle(sine: Vector, cosine: Vector) -> Vector:
    """Return the angles in [0, pi] of vectors with sines >= 0; both may have any common factor."""
    ahead = abs(cosine)
    beyond = sine > ahead
    small, large = beyond.select(ahead, sine), beyond.select(sine, ahead)
    # Beyond an eighth of a half turn, what is missing to two eighths.
    steep = small > large * STEEP_LIMIT
    # tan(angle - pi / 4) = (small - large) / (small + large)
    z = steep.select(small - large, small) / steep.select(small + large, large).maximum(TINY_LENGTH)
    angle = _polynomial(ARCTANGENT, z * z) * z
    angle = steep.select(angle + math.pi / 4, angle)
    angle = beyond.select(angle * -1.0 + math.pi / 2, angle)
    return (cosine < 0.0).select(angle * -1.0 + math.pi, angle)


def _constant_one(builder: ir.IRBuilder) -> Vector:
    return broadcast(builder, ir.Constant(ir.DoubleType(), 1.0))


def _cross(a: Sequence[Vector], b: Sequence[Vector]) -> list[Vector]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _dot(a: Sequence[Vector], b: Sequence[Vector]) -> Vector:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@intrinsic
def vertex_rows(
    typingctx: TypingContext, points: Address, x: float, y: float, z: float, near: float, vertex: Address
) -> Intrinsic:
    """Write the rows of a vertex as seen from the points; bit k: point k is nearer to it than ``near``."""
    signature = types.int64(types.uintp, *[types.float64] * 4, types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        seen_from, rows = (VectorRows(builder, address, DOUBLE8) for address in (args[0], args[5]))
        way = [broadcast(builder, args[1 + axis]) - seen_from[axis] for axis in range(3)]
        length = _dot(way, way).sqrt()
        inverse = _constant_one(builder) / length.maximum(TINY_LENGTH)
        rows[INVERSE_DISTANCE] = inverse
        for axis in range(3):
            rows[axis] = way[axis] * inverse
        return (length < broadcast(builder, args[4])).to_bitmask()

    return signature, codegen


@intrinsic
def edge_rows(typingctx: TypingContext, a: Address, b: Address, edge: Address) -> Intrinsic:
    """Write the row of the edge between two vertices; bit k: point k sees it under a wide angle.

    Then the row is not right; :func:`edge_rows_wide` writes it.
    """
    signature = types.int64(types.uintp, types.uintp, types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        a, b = (_read_direction(builder, address) for address in args[:2])
        cosine = _dot(a, b)
        VectorRows(builder, args[2], DOUBLE8)[0] = _polynomial(NARROW, cosine * -1.0 + 1.0)
        return (cosine < WIDE_ANGLE).to_bitmask()

    return signature, codegen


@intrinsic
def edge_rows_wide(typingctx: TypingContext, a: Address, b: Address, edge: Address) -> Intrinsic:
    """Write the row of the edge between two vertices, whatever its angle."""
    signature = types.void(types.uintp, types.uintp, types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        a, b = (_read_direction(builder, address) for address in args[:2])
        across = _cross(a, b)
        sine = _dot(across, across).sqrt()
        half = _angle(sine, _dot(a, b)) * 0.5
        VectorRows(builder, args[2], DOUBLE8)[0] = half / sine.maximum(TINY_LENGTH)
        return context.get_dummy_value()

    return signature, codegen


def _read_direction(builder: ir.IRBuilder, address: ir.Value) -> list[Vector]:
    rows = VectorRows(builder, address, DOUBLE8)
    return [rows[axis] for axis in range(3)]


class _Triangle:
    """A triangle seen from the points: what its corners' mean-value weights are computed from.

    Attributes:
        units: unit directions from the points to the corners.
        edge_plane_normals: normals of the planes through the points and an edge, edge k opposite of corner k.
        determinant: signed, of the three directions; six times the volume of their tetrahedron.
    """

    def __init__(self, builder: ir.IRBuilder, corners: ir.Value, edges: ir.Value) -> None:
        self._builder = builder
        self.units = [_read_direction(builder, builder.extract_value(corners, k)) for k in range(3)]
        self.edge_plane_normals = [_cross(self.units[(k + 1) % 3], self.units[(k + 2) % 3]) for k in range(3)]
        self.determinant = _dot(self.units[0], self.edge_plane_normals[0])
        self._half_angles_over_sine = [
            VectorRows(builder, builder.extract_value(edges, k), DOUBLE8)[0] for k in range(3)
        ]

    def emit_corner_weights(self, active: Vector, accumulators: ir.Value) -> None:
        """Emit code that adds each corner's mean-value weight to the accumulator in memory of that corner.

        The weight of corner k is normal_k . mean / determinant, where the mean vector is the sum of the
        edge planes' normals, each by half the edge's angle over its sine (Ju, Schaefer, Warren 2005).

        Args:
            active: mask of the points that the triangle counts for; the others add 0.
            accumulators: addresses of the corners' rows.
        """
        builder, normals, factors = self._builder, self.edge_plane_normals, self._half_angles_over_sine
        mean = [
            factors[0] * normals[0][axis] + factors[1] * normals[1][axis] + factors[2] * normals[2][axis]
            for axis in range(3)
        ]
        inverse_determinant = active.select(_constant_one(builder) / self.determinant, 0.0)
        for k, normal in enumerate(normals):
            accumulator = VectorRows(builder, builder.extract_value(accumulators, k), DOUBLE8)
            accumulator[0] = accumulator[0] + _dot(mean, normal) * inverse_determinant  # stores to memory


THREE_CORNERS = types.UniTuple(types.uintp, 3)


@intrinsic
def add_means(
    typingctx: TypingContext,
    corners: tuple[Address, Address, Address],
    edges: tuple[Address, Address, Address],
    sums: tuple[Address, Address, Address],
) -> Intrinsic:
    """Add what a triangle counts for its corners to their sums; bit k: not for point k, to which it is flat.

    All three arguments hold three addresses, of edge k that of the one opposite of corner k.
    """
    signature = types.int64(THREE_CORNERS, THREE_CORNERS, THREE_CORNERS)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        triangle = _Triangle(builder, *args[:2])
        solid = abs(triangle.determinant) > FLAT_TOLERANCE
        triangle.emit_corner_weights(solid, args[2])
        return (~solid).to_bitmask()

    return signature, codegen


@intrinsic
def add_means_in_plane(
    typingctx: TypingContext,
    corners: tuple[Address, Address, Address],
    edges: tuple[Address, Address, Address],
    sums: tuple[Address, Address, Address],
) -> Intrinsic:
    """Add what :func:`add_means` left out, of points in the triangle's plane; bit k: point k lies on it."""
    signature = types.int64(THREE_CORNERS, THREE_CORNERS, THREE_CORNERS)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        triangle = _Triangle(builder, *args[:2])
        u, sines = triangle.units, [_dot(normal, normal).sqrt() for normal in triangle.edge_plane_normals]
        size = abs(triangle.determinant)
        beside = size <= sines[0] * FLAT_TOLERANCE
        # In the triangle's plane but not on it, a triangle counts nothing.
        triangle.emit_corner_weights((size <= FLAT_TOLERANCE) & ~beside, args[2])
        angle_sum = _angle(sines[0], _dot(u[1], u[2]))
        for k in (1, 2):
            angle_sum = angle_sum + _angle(sines[k], _dot(u[(k + 1) % 3], u[(k + 2) % 3]))
        return (beside & (angle_sum >= TURN - TURN_TOLERANCE)).to_bitmask()

    return signature, codegen


@intrinsic
def add_solid_angle(
    typingctx: TypingContext, corners: tuple[Address, Address, Address], total: Address
) -> Intrinsic:
    """Add half the solid angle of a triangle (Van Oosterom and Strackee 1983) to a row."""
    signature = types.void(THREE_CORNERS, types.uintp)

    def codegen(
        context: BaseContext, builder: ir.IRBuilder, sig: Signature, args: Sequence[ir.Value]
    ) -> ir.Value:
        a, b, c = (_read_direction(builder, builder.extract_value(args[0], k)) for k in range(3))
        volume = _dot(a, _cross(b, c))
        # tan(solid angle / 2) = a . (b x c) / (1 + a . b + b . c + c . a) for unit vectors
        angle = _angle(abs(volume), _dot(a, b) + _dot(b, c) + _dot(c, a) + 1.0)
        rows = VectorRows(builder, args[1], DOUBLE8)
        rows[0] = rows[0] + (volume < 0.0).select(angle * -1.0, angle)
        return context.get_dummy_value()

    return signature, codegen
