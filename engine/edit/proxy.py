"""Proxies: coarse meshes to which octagon corners are bound, and whose deformation these follow.

Two ways. *Nearest*: a corner follows the affine maps of the triangles around the nearest one, blended with
smooth weights; made for open surfaces such as a cloth or a hull. *Mean value*: a corner is a smooth
combination of all vertices of a closed cage around it, which reproduces every affine map exactly.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, Int64

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.edit.kernels.mean_value import POINTS_PER_TASK, mean_value_weights, winding_numbers
from octasplat.engine.edit.kernels.proxy import blend
from octasplat.engine.edit.mirror_detection import was_mirrored
from octasplat.engine.edit.near_triangles import NearTriangles
from octasplat.engine.gaussians.apply_legs import ROWS_PER_BLOCK, row_blocks

Method = Literal["nearest", "mvc"]
MAX_CACHE_BYTES = 1 << 29
"""What ties the corners to the proxy is kept from frame to frame up to this size, and found anew beyond."""
VALUES_PER_BLOCK = 1 << 23
"""Most mean-value coordinates that are computed at once."""
DEFAULT_REACH = 0.1
"""How far a surface moves what is around it, as a share of the diagonal of its bounding box."""


@dataclass(frozen=True)
class Proxy:
    """A triangle mesh in the scene's frame.

    Attributes:
        vertices_world: positions at rest.
        triangles: vertex indices; those without area are of no use and left out.
        mirrored_override: whether its deformations mirror it, if somebody knows; else they are looked at.
    """

    vertices_world: Float64[np.ndarray, "v 3"]
    triangles: Int64[np.ndarray, "t 3"]
    mirrored_override: bool | None = None

    def __post_init__(self) -> None:
        """Drop triangles without area."""
        corners = self.vertices_world[self.triangles]
        area = np.linalg.norm(_area_vectors(corners), axis=-1)
        object.__setattr__(self, "triangles", self.triangles[area > 1e-14 * max(self.diagonal, 1e-300) ** 2])
        if not len(self.triangles):
            raise SceneFileError("The proxy has no triangle with an area; it needs faces.")

    @property
    def diagonal(self) -> float:
        """Return the diagonal of the bounding box in world units."""
        return float(np.linalg.norm(np.ptp(self.vertices_world, axis=0)))

    def is_mirrored(self, vertices_world: Float64[np.ndarray, "v 3"]) -> bool:
        """Return whether moving the vertices to ``vertices_world`` mirrors the space around the mesh."""
        if self.mirrored_override is not None:
            return self.mirrored_override
        return was_mirrored(self.vertices_world, vertices_world, self.triangles, self.is_closed())

    def is_closed(self) -> bool:
        """Return whether every edge has two triangles, which run along it in opposite directions."""
        edges = self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        # An edge as one number, and its reverse as another
        codes = edges[:, 0] * len(self.vertices_world) + edges[:, 1]
        back = edges[:, 1] * len(self.vertices_world) + edges[:, 0]
        return len(np.unique(codes)) == len(codes) and np.array_equal(np.sort(codes), np.sort(back))


@runtime_checkable
class Binding(Protocol):
    """Octagon corners tied to a proxy."""

    @property
    def moving_mask(self) -> Bool[np.ndarray, " n"]:
        """Return a mask of the Gaussians that the proxy moves at all."""
        ...

    def deform(self, vertices_world: Float64[np.ndarray, "v 3"]) -> Float64[np.ndarray, "n 8 3"]:
        """Return the corners for the proxy's vertices at ``vertices_world``."""
        ...

    def mirrored_mask(self, vertices_world: Float64[np.ndarray, "v 3"]) -> Bool[np.ndarray, " n"]:
        """Return a mask of the Gaussians around which that deformation mirrors space."""
        ...


def bind_corners(
    proxy: Proxy,
    corners_world: Float64[np.ndarray, "n 8 3"],
    method: Method = "nearest",
    reach_world: float | None = None,
) -> Binding:
    """Bind octagon corners to ``proxy`` at rest.

    Args:
        proxy: for ``mvc`` a closed mesh.
        corners_world: octagon corners of the undeformed scene.
        method: see the module.
        reach_world: corners up to this distance from the proxy follow it fully, those beyond twice the
            distance stay, with a smooth change in between. None means a tenth of the proxy's diagonal for
            ``nearest``, and for ``mvc`` that the Gaussians inside the cage follow and no others.

    Raises:
        SceneFileError: ``mvc`` with a mesh that is not closed.
    """
    if method == "mvc":
        return MeanValueBinding(proxy, corners_world, reach_world)
    reach = DEFAULT_REACH * proxy.diagonal if reach_world is None else reach_world
    return NearestBinding(proxy, corners_world, reach)


@dataclass(frozen=True)
class _TriangleWeights:
    """Triangles that move points, those of point i from ``starts[i]`` to ``starts[i + 1]``, with weights."""

    starts: Int64[np.ndarray, " p1"]
    triangles: Int32[np.ndarray, " k"]
    weights: Float32[np.ndarray, " k"]

    @property
    def nbytes(self) -> int:
        return self.starts.nbytes + self.triangles.nbytes + self.weights.nbytes


class NearestBinding:
    """Corners bound to the triangles near them."""

    def __init__(self, proxy: Proxy, corners_world: Float64[np.ndarray, "n 8 3"], reach_world: float) -> None:
        self._proxy = proxy
        self._corners = corners_world
        self._reach = reach_world
        self._near = NearTriangles(proxy.vertices_world[proxy.triangles])
        self._influence = np.empty(corners_world.shape[:2])
        self._stored: list[_TriangleWeights | None] = []
        room = MAX_CACHE_BYTES
        for block in row_blocks(len(corners_world)):
            ties, self._influence[block] = self._bind_corners(corners_world[block])
            room -= ties.nbytes
            self._stored.append(ties if room >= 0 else None)
        self._frames = _triangle_frames(proxy.vertices_world[proxy.triangles])
        self._centres = proxy.vertices_world[proxy.triangles].mean(axis=1)

    @property
    def moving_mask(self) -> Bool[np.ndarray, " n"]:
        """Return a mask of the Gaussians with a corner within reach."""
        result: np.ndarray = self._influence.max(axis=1) > 0
        return result

    def deform(self, vertices_world: Float64[np.ndarray, "v 3"]) -> Float64[np.ndarray, "n 8 3"]:
        """Return the corners for the proxy's vertices at ``vertices_world``."""
        moved = _check_vertices(vertices_world, self._proxy)[self._proxy.triangles]
        rest = self._proxy.vertices_world[self._proxy.triangles]
        side = -1.0 if self._proxy.is_mirrored(vertices_world) else 1.0
        # F = moved frame . (rest frame)^-1 takes edges to edges, and the normal to the normal.
        derivatives = _moved_frames(moved, rest, side) @ np.linalg.inv(self._frames)
        moved_centres = moved.mean(axis=1)
        result = np.empty_like(self._corners)
        for block, stored in zip(row_blocks(len(self._corners)), self._stored, strict=True):
            corners = self._corners[block]
            ties = self._bind_corners(corners)[0] if stored is None else stored
            points, places = np.ascontiguousarray(corners.reshape(-1, 3)), np.empty((corners.size // 3, 3))
            run_ranges(
                blend, threads_in_use(), len(points),
                points, ties.starts, ties.triangles, ties.weights, derivatives, self._centres, moved_centres,
                places,
            )  # fmt: skip
            result[block] = _blend_corners(corners, places.reshape(corners.shape), self._influence[block])
        return result

    def mirrored_mask(self, vertices_world: Float64[np.ndarray, "v 3"]) -> Bool[np.ndarray, " n"]:
        """Return the Gaussians that follow the proxy by more than half, if it was mirrored."""
        return _mirrored_followers(self._influence, self._proxy.is_mirrored(vertices_world))

    def _bind_corners(
        self, corners_world: Float64[np.ndarray, "n 8 3"]
    ) -> tuple[_TriangleWeights, Float64[np.ndarray, "n 8"]]:
        """Return the triangles that move corners, and the corners' influence in [0, 1]."""
        chosen, weights, distances = self._near.query(corners_world.reshape(-1, 3))
        influence = _smooth_falloff(distances, self._reach)
        used = (weights > 0) & (influence > 0)[:, None]
        starts = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
        return _TriangleWeights(starts, chosen[used], weights[used]), influence.reshape(
            corners_world.shape[:2]
        )


class MeanValueBinding:
    """Corners bound to a closed cage by mean-value coordinates."""

    def __init__(
        self, proxy: Proxy, corners_world: Float64[np.ndarray, "n 8 3"], reach_world: float | None
    ) -> None:
        if not proxy.is_closed():
            raise SceneFileError(
                "The proxy is not closed (some edge has not exactly two faces that agree in direction), but "
                "mean-value coordinates need a closed cage; close it, or use the method nearest."
            )
        self._proxy = proxy
        self._corners = corners_world
        winding = np.zeros(len(corners_world), np.int64)
        run_ranges(
            winding_numbers, threads_in_use(), -(-len(winding) // POINTS_PER_TASK),
            corners_world.mean(axis=1), proxy.vertices_world, proxy.triangles, winding, grain=1,
        )  # fmt: skip
        inside = (winding != 0).astype(np.float64)
        self._influence = np.repeat(inside[:, None], corners_world.shape[1], axis=1)
        if reach_world is not None and reach_world > 0:
            near = NearTriangles(proxy.vertices_world[proxy.triangles])
            for block in row_blocks(len(corners_world)):
                distances = near.query(corners_world[block].reshape(-1, 3))[2]
                faded = _smooth_falloff(distances, reach_world).reshape(-1, corners_world.shape[1])
                self._influence[block] = np.maximum(self._influence[block], faded)
        self._rows = np.flatnonzero(self._influence.max(axis=1) > 0)
        self._edges, self._opposite = _edges(proxy.triangles)
        numbers_a_row = corners_world.shape[1] * len(proxy.vertices_world)
        self._rows_at_once = max(1, min(ROWS_PER_BLOCK, VALUES_PER_BLOCK // numbers_a_row))
        self._stored: list[np.ndarray] | None = None
        if self._rows.size * numbers_a_row * 8 <= MAX_CACHE_BYTES:
            self._stored = [self._corner_coordinates(self._rows[block]) for block in self._row_blocks()]

    @property
    def moving_mask(self) -> Bool[np.ndarray, " n"]:
        """Return a mask of the Gaussians in the cage or within reach of it."""
        result: np.ndarray = self._influence.max(axis=1) > 0
        return result

    def deform(self, vertices_world: Float64[np.ndarray, "v 3"]) -> Float64[np.ndarray, "n 8 3"]:
        """Return the corners for the cage's vertices at ``vertices_world``."""
        shifts = _check_vertices(vertices_world, self._proxy) - self._proxy.vertices_world
        result = self._corners.copy()
        for number, block in enumerate(self._row_blocks()):
            rows = self._rows[block]
            weights = self._corner_coordinates(rows) if self._stored is None else self._stored[number]
            corners = self._corners[rows]
            # Moved by the shifts of the vertices, so that a cage at rest leaves every corner exactly
            moved = corners + (weights @ shifts).reshape(corners.shape)
            result[rows] = _blend_corners(corners, moved, self._influence[rows])
        return result

    def mirrored_mask(self, vertices_world: Float64[np.ndarray, "v 3"]) -> Bool[np.ndarray, " n"]:
        """Return the Gaussians that follow the cage by more than half, if it was mirrored."""
        return _mirrored_followers(self._influence, self._proxy.is_mirrored(vertices_world))

    def _row_blocks(self) -> list[slice]:
        return list(row_blocks(len(self._rows), self._rows_at_once))

    def _corner_coordinates(self, rows: Int64[np.ndarray, " r"]) -> Float64[np.ndarray, "p v"]:
        """Return the mean-value coordinates of the corners of some Gaussians."""
        points = self._corners[rows].reshape(-1, 3)
        weights = np.empty((len(points), len(self._proxy.vertices_world)))
        proxy = self._proxy
        run_ranges(
            mean_value_weights, threads_in_use(), -(-len(points) // POINTS_PER_TASK),
            points, proxy.vertices_world, proxy.triangles, self._edges, self._opposite, proxy.diagonal,
            weights, grain=1,
        )  # fmt: skip
        return weights


def _edges(
    triangles: Int64[np.ndarray, "t 3"],
) -> tuple[Int64[np.ndarray, "e 2"], Int64[np.ndarray, "t 3"]]:
    """Return each edge once, and the edge opposite to each corner of each triangle."""
    both = np.sort(triangles[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
    size = int(both.max()) + 1
    keys, number = np.unique(both[:, 0] * size + both[:, 1], return_inverse=True)
    return np.stack([keys // size, keys % size], axis=1), number.reshape(-1, 3)


def _area_vectors(corners: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, "t 3"]:
    """Return normals whose length is twice the triangle's area."""
    result: np.ndarray = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return result


def _triangle_frames(corners: Float64[np.ndarray, "t 3 3"]) -> Float64[np.ndarray, "t 3 3"]:
    """Return matrices whose columns are two edges and the unit normal."""
    return _moved_frames(corners, corners, 1.0)


def _moved_frames(
    corners: Float64[np.ndarray, "t 3 3"], rest: Float64[np.ndarray, "t 3 3"], side: float
) -> Float64[np.ndarray, "t 3 3"]:
    """Return frames as columns: two edges, and the normal times ``side`` and the root of the area ratio."""
    vectors, area = _area_vectors(corners), np.linalg.norm(_area_vectors(rest), axis=-1)
    now = np.linalg.norm(vectors, axis=-1)
    normals = side * vectors / np.maximum(np.sqrt(now * area), 1e-300)[:, None]
    edges = [corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]]
    return np.stack([*edges, normals], axis=-1)


def _smooth_falloff(distances: Float64[np.ndarray, " p"], reach: float) -> Float64[np.ndarray, " p"]:
    """Return 1 up to ``reach``, 0 from twice that on, and a smooth transition between."""
    if np.isinf(reach):
        return np.ones_like(distances)
    t = np.clip(2.0 - distances / max(reach, 1e-300), 0.0, 1.0)
    result: np.ndarray = t * t * (3.0 - 2.0 * t)
    return result


def _blend_corners(
    rest: Float64[np.ndarray, "n 8 3"],
    moved: Float64[np.ndarray, "n 8 3"],
    influence: Float64[np.ndarray, "n 8"],
) -> Float64[np.ndarray, "n 8 3"]:
    """Return corners blended by their influence; those with none stay exactly."""
    share = influence[:, :, None]
    result: np.ndarray = np.where(share > 0, rest + share * (moved - rest), rest)
    return result


def _mirrored_followers(influence: Float64[np.ndarray, "n 8"], mirrored: bool) -> Bool[np.ndarray, " n"]:
    """Return Gaussians that follow a mirrored proxy by more than half and whose blend mirrors, too."""
    result: np.ndarray = (influence.mean(axis=1) > 0.5) & mirrored
    return result


def _check_vertices(vertices_world: Float64[np.ndarray, "v 3"], proxy: Proxy) -> Float64[np.ndarray, "v 3"]:
    if vertices_world.shape != proxy.vertices_world.shape:
        raise SceneFileError(
            f"The deformed proxy has {len(vertices_world)} vertices, but at rest it has "
            f"{len(proxy.vertices_world)}; both must be the same mesh."
        )
    return vertices_world
