"""Rays as every part of the engine passes them on: from cameras and photographs to whatever traces them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int

_FROM_START = np.zeros(1, np.float32)
_TO_INFINITY = np.full(1, np.inf, np.float32)


@dataclass(frozen=True, init=False, eq=False)
class RayBatch:
    """The points ``origin + t * direction`` with ``t_min < t < t_max`` of ``r`` rays.

    Distances count from the origin, in lengths of the direction. The origin need not be where a ray starts:
    rays that seem to come from one point share it as their origin, whatever lies between, and ``t_min`` says
    where each begins. So a camera's rays behind a plane mirror have the mirrored camera as their origin and
    begin at the mirror (:meth:`mirrored`), and the ways between a point light and many points are rays from
    the light that end at the points (:meth:`between`). Tracers follow neighbours with one origin together.

    ``t_min`` and ``t_max`` have one value a ray, or a single one that stands for all.

    >>> rays = RayBatch(np.zeros((2, 3), np.float32), np.eye(3, dtype=np.float32)[:2], t_min=0.5)
    >>> len(rays), rays.t_min.tolist(), rays.t_max.tolist()
    (2, [0.5], [inf])
    """

    origins_world: Float32[np.ndarray, "r 3"]
    directions_world: Float32[np.ndarray, "r 3"]
    t_min: Float32[np.ndarray, "#r"]
    t_max: Float32[np.ndarray, "#r"]

    def __init__(
        self,
        origins_world: Float[np.ndarray, "#r 3"],
        directions_world: Float[np.ndarray, "r 3"],
        t_min: Float[np.ndarray, "#r"] | float | None = None,
        t_max: Float[np.ndarray, "#r"] | float | None = None,
    ) -> None:
        """Rays through ``directions_world``; a single origin stands for all, and so does a single limit.

        ``t_min`` is 0 and ``t_max`` infinite where nothing is given.
        """
        directions = np.ascontiguousarray(directions_world, np.float32)
        origins = np.ascontiguousarray(np.broadcast_to(origins_world, directions.shape), np.float32)
        object.__setattr__(self, "origins_world", origins)
        object.__setattr__(self, "directions_world", directions)
        object.__setattr__(self, "t_min", _limits(t_min, _FROM_START))
        object.__setattr__(self, "t_max", _limits(t_max, _TO_INFINITY))

    @classmethod
    def between(
        cls,
        starts_world: Float[np.ndarray, "#r 3"],
        ends_world: Float[np.ndarray, "r 3"],
        gap: float = 0.0,
    ) -> "RayBatch":
        """Unit rays from each start to each end that stop ``gap`` (world units) before the end.

        A ray between two equal points has the direction z and no length.
        """
        ways = np.asarray(ends_world, np.float64) - starts_world
        lengths = np.linalg.norm(ways, axis=1)
        ways[lengths == 0] = (0.0, 0.0, 1.0)
        directions = (ways / np.maximum(lengths, 1e-300)[:, None]) if len(ways) else ways
        directions[lengths == 0] = (0.0, 0.0, 1.0)
        return cls(starts_world, directions, 0.0, np.maximum(lengths - gap, 0.0))

    def __len__(self) -> int:
        return len(self.directions_world)

    def __getitem__(self, which: slice | Int[np.ndarray, " k"] | np.ndarray) -> "RayBatch":
        """The rays of a slice, of numbers or of a mask."""
        return RayBatch(
            self.origins_world[which],
            self.directions_world[which],
            self.t_min if len(self.t_min) == 1 else self.t_min[which],
            self.t_max if len(self.t_max) == 1 else self.t_max[which],
        )

    @cached_property
    def starts_world(self) -> Float32[np.ndarray, "r 3"]:
        """Where each ray begins: the point at ``t_min``."""
        return np.asarray(self.origins_world + self.t_min[:, None] * self.directions_world)

    def mirrored(
        self,
        point_world: Float[np.ndarray, "3"],
        normal_world: Float[np.ndarray, "3"],
        t_mirror: Float[np.ndarray, " r"],
    ) -> "RayBatch":
        """These rays after their reflection in one plane, which they meet at ``t_mirror``.

        They begin at the mirror, and distances go on counting from where they counted before. The reflections
        of rays with one origin have one origin.

        Args:
            point_world: any point of the plane.
            normal_world: the plane's normal, of any length and sign.
            t_mirror: where each ray meets the plane; what lies on its near side is left out.
        """
        normal = np.asarray(normal_world, np.float64)
        normal = normal / np.linalg.norm(normal)
        origins, directions = self.origins_world.astype(np.float64), self.directions_world.astype(np.float64)
        origins -= 2 * ((origins - point_world) @ normal)[:, None] * normal
        directions -= 2 * (directions @ normal)[:, None] * normal
        return RayBatch(origins, directions, np.maximum(t_mirror, self.t_min), self.t_max)


def _limits(
    given: Float[np.ndarray, "#r"] | float | None, default: Float32[np.ndarray, "1"]
) -> Float32[np.ndarray, "#r"]:
    return default if given is None else np.ascontiguousarray(given, np.float32).reshape(-1)
