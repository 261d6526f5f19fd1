"""A lattice of cubes around a mesh: what a physics engine moves, and how Gaussians ride in it.

Nothing here knows of any engine: it needs tetrahedra in, and the lattice's nodes out, frame by frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.ndimage import binary_fill_holes, distance_transform_edt

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.edit.deform import deform_to, deformation_corners
from octasplat.engine.edit.kernels.mean_value import POINTS_PER_TASK, winding_numbers
from octasplat.engine.evaluate.surface_metrics import distances_to_surface, sample_surface
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.geometry.triangle_mesh import TriangleMesh

CORNERS = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in range(8)])
"""Corner k of a cell, in cells from its least corner."""
KUHN = np.array([[0, 3, 1, 7], [0, 1, 5, 7], [0, 5, 4, 7], [0, 2, 3, 7], [0, 6, 2, 7], [0, 4, 6, 7]])
"""Six tetrahedra around the diagonal from corner 0 to 7; cells next to each other fit together."""


@dataclass(frozen=True)
class Lattice:
    """Cubic cells that hold a body.

    Attributes:
        nodes_world: positions of the nodes at rest.
        cells: the eight nodes of each cell, in the order of ``CORNERS``.
        low_world: least corner of the grid that the cells are part of.
        cell_side: world units.
        nearest_cell: for every place of the grid, the number of the nearest cell.
    """

    nodes_world: Float64[np.ndarray, "v 3"]
    cells: Int64[np.ndarray, "c 8"]
    low_world: Float64[np.ndarray, "3"]
    cell_side: float
    nearest_cell: Int64[np.ndarray, "x y z"]

    @property
    def tetrahedra(self) -> Int64[np.ndarray, "t 4"]:
        """Six tetrahedra a cell, all of positive volume."""
        return self.cells[:, KUHN].reshape(-1, 4)

    @property
    def volume(self) -> float:
        """Of all cells, cubic world units."""
        return len(self.cells) * self.cell_side**3


def lattice_around(mesh: TriangleMesh, cell_side: float) -> Lattice:
    """The cells that a closed mesh passes or encloses."""
    points, _ = sample_surface(mesh, 400_000, np.random.default_rng(0))
    low = points.min(axis=0) - 1.5 * cell_side
    place = ((points - low) / cell_side).astype(np.int64)
    filled = np.zeros(place.max(axis=0) + 2, dtype=bool)
    filled[tuple(place.T)] = True
    filled = binary_fill_holes(filled)
    cells_at = np.argwhere(filled)
    corners = cells_at[:, None] + CORNERS
    shape = np.array(filled.shape) + 1
    used, cells = np.unique(np.ravel_multi_index(corners.reshape(-1, 3).T, shape), return_inverse=True)
    nodes = low + cell_side * np.stack(np.unravel_index(used, shape), axis=1)
    number = np.full(filled.shape, -1, np.int64)
    number[filled] = np.arange(len(cells_at))
    nearest = distance_transform_edt(~filled, return_distances=False, return_indices=True)
    return Lattice(nodes, cells.reshape(-1, 8), low, cell_side, number[tuple(nearest)])


def belongs_to(gaussians: FlatGaussians, mesh: TriangleMesh, near: float) -> Bool[np.ndarray, " n"]:
    """Which Gaussians have their centre inside a closed mesh or no farther from it than ``near``."""
    centres = gaussians.means_world.astype(np.float64)
    low, high = mesh.vertices_world.min(axis=0) - near, mesh.vertices_world.max(axis=0) + near
    chosen = ((centres >= low) & (centres <= high)).all(axis=1)
    some = np.flatnonzero(chosen)
    turns = np.zeros(len(some), np.int64)
    vertices, faces = mesh.vertices_world.astype(np.float64), mesh.faces.astype(np.int64)
    tasks = -(-len(some) // POINTS_PER_TASK)
    run_ranges(winding_numbers, threads_in_use(), tasks, centres[some], vertices, faces, turns, grain=1)
    close = distances_to_surface(centres[some], mesh, np.random.default_rng(0), 200_000) <= near
    chosen[some] = close | (turns != 0)
    return chosen


class Rider:
    """Gaussians that ride in a lattice: every octagon corner keeps its place in its cell.

    Places are trilinear, so that they are continuous from cell to cell and nothing tears; a corner outside
    of all cells goes by the nearest one, extended.
    """

    def __init__(self, gaussians: FlatGaussians, lattice: Lattice) -> None:
        self._gaussians = gaussians
        self._corners = deformation_corners(gaussians)
        points = (self._corners.reshape(-1, 3) - lattice.low_world) / lattice.cell_side
        place = np.clip(points.astype(np.int64), 0, np.array(lattice.nearest_cell.shape) - 1)
        cell = lattice.nearest_cell[tuple(place.T)]
        self._nodes = lattice.cells[cell]
        start = lattice.nodes_world[self._nodes[:, 0]]
        share = (self._corners.reshape(-1, 3) - start) / lattice.cell_side
        sides = np.where(CORNERS[None] == 1, share[:, None], 1 - share[:, None])
        self._weights = sides.prod(axis=2)

    def at(self, nodes_world: Float64[np.ndarray, "v 3"]) -> FlatGaussians:
        """The Gaussians when the lattice's nodes are there."""
        moved = np.einsum("pk,pkc->pc", self._weights, nodes_world[self._nodes])
        return deform_to(self._gaussians, self._corners, moved.reshape(self._corners.shape))[0]
