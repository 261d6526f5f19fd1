"""Batches of rays, as cameras, photographs and tracers exchange them."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Float64, Int

AT_INFINITY = -np.inf
"""Viewer of rays whose colors are those in their own direction."""
SHIFTED_PIXELS_AT_ONCE = 1 << 16
"""Rays of so many pixels are offset at a time, as that is worked out in float64."""


@dataclass(frozen=True, init=False, eq=False)
class RayBatch:
    """The points ``origin + t * direction`` with ``t_min < t < t_max`` of ``r`` rays.

    Distances count from the origin, in lengths of the direction. The origin need not be where a ray starts:
    rays that seem to come from one point share it as their origin, whatever lies between, and ``t_min`` says
    where each begins. So a camera's rays behind a plane mirror have the mirrored camera as their origin and
    begin at the mirror (:meth:`reflect`), and the ways between a point light and many points are rays from
    the light that end at the points (:meth:`between`). Tracers follow neighbours with one origin together.

    ``t_view_origin`` says where on each ray its viewer stands. Colors that depend on the direction are
    those in
    the direction from there to a Gaussian's mean, as in programs that draw splats. A camera's viewer is the
    origin (0). Rays that go on from a surface have none there: so close to it the direction to a mean would
    be any. Behind a mirror or clear glass the viewer stands as far back as the way has been long (below 0),
    so that a pane that bends nothing changes nothing; behind anything else it is infinitely far away
    (``AT_INFINITY``), and the direction is the ray's own.

    Rays that leave a surface of Gaussians may have some of these in their way, as the surface is as thick as
    their noise. Up to ``t_backface_cull`` a ray passes all Gaussians that it would meet from behind, which
    is how it meets those of the surface that it leaves. Tracers for normals without a side know no behind.

    Origins, limits and viewers have one row a ray, or a single one that stands for all.

    >>> rays = RayBatch(np.zeros((1, 3), np.float32), np.eye(3, dtype=np.float32)[:2], t_min=0.5)
    >>> len(rays), rays.t_min.tolist(), rays.t_max.tolist()
    (2, [0.5], [inf])
    """

    origins_world: Float32[np.ndarray, "#r 3"]
    directions_world: Float32[np.ndarray, "r 3"]
    t_min: Float32[np.ndarray, "#r"]
    t_max: Float32[np.ndarray, "#r"]
    t_view_origin: Float32[np.ndarray, "#r"]
    t_backface_cull: Float32[np.ndarray, "#r"]

    def __init__(
        self,
        origins_world: Float[np.ndarray, "#r 3"],
        directions_world: Float[np.ndarray, "r 3"],
        t_min: Float[np.ndarray, "#r"] | float = 0.0,
        t_max: Float[np.ndarray, "#r"] | float = np.inf,
        t_view_origin: Float[np.ndarray, "#r"] | float = 0.0,
        t_backface_cull: Float[np.ndarray, "#r"] | float = 0.0,
    ) -> None:
        """Store rays along ``directions_world``; a ``t_min`` below 0 counts as 0."""
        object.__setattr__(self, "origins_world", _for_kernels(origins_world))
        object.__setattr__(self, "directions_world", _for_kernels(directions_world))
        object.__setattr__(self, "t_min", _for_kernels(np.maximum(np.atleast_1d(t_min), 0)))
        object.__setattr__(self, "t_max", _for_kernels(np.atleast_1d(t_max)))
        object.__setattr__(self, "t_view_origin", _for_kernels(np.atleast_1d(t_view_origin)))
        object.__setattr__(self, "t_backface_cull", _for_kernels(np.atleast_1d(t_backface_cull)))

    @classmethod
    def between(
        cls,
        starts_world: Float[np.ndarray, "#r 3"],
        ends_world: Float[np.ndarray, "r 3"],
        gap: float = 0.0,
    ) -> "RayBatch":
        """Return unit rays from each start to each end that stop ``gap`` (world units) before the end.

        A ray between two equal points looks along z and has no length.

        >>> rays = RayBatch.between(np.zeros((1, 3)), np.array([[0.0, 0.0, 4.0]]), gap=1.0)
        >>> rays.directions_world.tolist(), rays.t_max.tolist()
        ([[0.0, 0.0, 1.0]], [3.0])
        """
        # From the start as it is stored, in 32 bits: only so does the ray lead to the end.
        ways = np.asarray(ends_world, np.float64) - np.asarray(starts_world, np.float32)
        lengths = np.linalg.norm(ways, axis=1)
        ways[lengths == 0] = (0.0, 0.0, 1.0)
        directions = ways / np.where(lengths == 0, 1.0, lengths)[:, None]
        return cls(starts_world, directions, 0.0, np.maximum(lengths - gap, 0.0))

    def __len__(self) -> int:
        return len(self.directions_world)

    def __getitem__(self, which: slice | Int[np.ndarray, " k"] | np.ndarray) -> "RayBatch":
        """Return the rays that a slice, indices or a mask select."""
        return RayBatch(*(rows if len(rows) == 1 and len(self) != 1 else rows[which] for rows in self.arrays))

    @property
    def arrays(self) -> tuple[Float32[np.ndarray, "#r *c"], ...]:
        """Return the arrays of the batch, in the order of its fields."""
        return (
            self.origins_world, self.directions_world, self.t_min, self.t_max,
            self.t_view_origin, self.t_backface_cull
        )  # fmt: skip

    def with_t_max(self, t_max: Float[np.ndarray, "#r"] | float) -> "RayBatch":
        """Return the rays with another ``t_max``."""
        return replace(self, t_max=np.atleast_1d(t_max))

    @cached_property
    def starts_world(self) -> Float32[np.ndarray, "r 3"]:
        """Return the point at ``t_min`` of each ray."""
        return np.asarray(self.origins_world + self.t_min[:, None] * self.directions_world)

    def reflect(
        self,
        point_world: Float[np.ndarray, "3"],
        normal_world: Float[np.ndarray, "3"],
        t_mirror: Float[np.ndarray, " r"],
    ) -> "RayBatch":
        """Return the rays after their reflection at a plane, which they meet at ``t_mirror``.

        They begin at the mirror, and distances go on counting from where they counted before. The reflections
        of rays with one origin have one origin.

        Args:
            point_world: any point of the plane.
            normal_world: the plane's normal, of any length and sign.
            t_mirror: where each ray meets the plane; what lies on its near side is left out.

        >>> down = RayBatch(np.zeros((1, 3), np.float32), np.array([[0.0, 0.0, 1.0]], np.float32))
        >>> mirrored = down.reflect(np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, 1.0]), np.array([2.0]))
        >>> mirrored.starts_world.tolist(), mirrored.directions_world.tolist()
        ([[0.0, 0.0, 2.0]], [[0.0, 0.0, -1.0]])
        """
        normal = np.asarray(normal_world, np.float64)
        normal = normal / np.linalg.norm(normal)
        origins, directions = self.origins_world.astype(np.float64), self.directions_world.astype(np.float64)
        # Householder reflection at the plane: x - 2 ((x - p) . n) n
        origins -= 2 * ((origins - point_world) @ normal)[:, None] * normal
        directions -= 2 * (directions @ normal)[:, None] * normal
        return RayBatch(
            origins_world=origins,
            directions_world=directions,
            t_min=np.maximum(t_mirror, self.t_min),
            t_max=self.t_max,
            t_view_origin=self.t_view_origin,
            t_backface_cull=self.t_backface_cull,
        )


def concatenate_rays(first: RayBatch, second: RayBatch) -> RayBatch:
    """Concatenate two batches; a row that stands for all rays of both is kept single."""

    def both(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        if len(one) == 1 and np.array_equal(one, other):
            return one
        wide = [np.broadcast_to(x, (len(of), *x.shape[1:])) for x, of in ((one, first), (other, second))]
        return np.concatenate(wide)

    origins, _, *limits = map(both, first.arrays, second.arrays)
    directions = np.concatenate([first.directions_world, second.directions_world])
    return RayBatch(origins, directions, *limits)


@dataclass(frozen=True)
class ImageRays:
    """The rays through the pixels of an image, row by row; all have one origin.

    ``axis_world`` is the camera's axis, a unit vector, which need not lead through the middle of the image;
    None where only the rays are known.
    """

    rays: RayBatch
    height_px: int
    width_px: int
    axis_world: Float64[np.ndarray, "3"] | None = None

    @classmethod
    def from_directions(
        cls,
        origin_world: Float[np.ndarray, "3"],
        directions_world: Float[np.ndarray, "h w 3"],
        near_world: float = 0.0,
        axis_world: Float[np.ndarray, "3"] | None = None,
    ) -> "ImageRays":
        """Return rays along unit directions that see nothing nearer than ``near_world``."""
        height, width = directions_world.shape[:2]
        rays = RayBatch(origin_world[None], directions_world.reshape(-1, 3), near_world)
        axis = None if axis_world is None else np.array(axis_world, np.float64)
        return cls(rays, height, width, axis)

    def shifted(self, across_px: float, down_px: float) -> "ImageRays":
        """Return the rays offset from the pixel centres, by finite differences of their neighbours."""
        if across_px == 0 and down_px == 0:
            return self
        given, shifted = self.directions_world, np.empty((self.height_px, self.width_px, 3), np.float32)
        rows = max(1, SHIFTED_PIXELS_AT_ONCE // max(self.width_px, 1))
        for top in range(0, self.height_px, rows):
            # with a row above and below, from which the differences are taken
            first, last = max(top - 1, 0), min(top + rows + 1, self.height_px)
            ways = _shifted_ways(given[first:last].astype(np.float64), across_px, down_px)
            shifted[top : top + rows] = ways[top - first : top - first + rows]
        return ImageRays.from_directions(
            self.origin_world, shifted, float(self.rays.t_min[0]), self.axis_world
        )

    @property
    def origin_world(self) -> Float32[np.ndarray, "3"]:
        """Return the camera centre in world coordinates."""
        return self.rays.origins_world[0]

    @property
    def directions_world(self) -> Float32[np.ndarray, "h w 3"]:
        """Return the direction of each pixel."""
        return self.rays.directions_world.reshape(self.height_px, self.width_px, 3)


def _shifted_ways(
    given: Float64[np.ndarray, "h w 3"], across_px: float, down_px: float
) -> Float64[np.ndarray, "h w 3"]:
    ways = given
    for axis, offset in ((1, across_px), (0, down_px)):
        if given.shape[axis] > 1:
            ways = ways + offset * np.gradient(given, axis=axis)
    return np.asarray(ways / np.linalg.norm(ways, axis=2, keepdims=True))


def _for_kernels(values: Float[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Return ``values`` in the array layout that kernels are compiled for, copied only where needed."""
    # Writable too: numba takes a read-only array for another type, and would compile the kernel again.
    return np.require(values, np.float32, ["C", "W"])
