"""Which vertex of an edited mesh is which corner of which Gaussian."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from engine.edit.mesh import Mesh
from engine.edit.octagon_fit import LEAST_CORNERS
from engine.errors import SceneFileError
from engine.gaussians.octagon import SIDES, corner_directions

ID_TOLERANCE = 1e-3
"""Numbers that an editor blended between vertices are further than this from whole ones."""
ADVICE = "Edit the mesh that was exported as PLY and save it as PLY, or the GLB with its attributes."
UV_TOLERANCE = 0.02
"""Share of the texture by which coordinates may differ from those exported (some editors keep 16 bits)."""


@dataclass(frozen=True)
class Octagons:
    """Octagons found in a mesh, ordered by Gaussian; the first of each Gaussian counts as the original.

    Attributes:
        gids: the Gaussian of each.
        corners_world: positions; zeros where missing.
        present: which corners are there.
        is_copy: whether the Gaussian has another octagon before this one: somebody duplicated it.
        matched_by: ``ids`` or ``order``.
        foreign_vertices: vertices that belong to no octagon (added, or blended by welding or subdividing).
        ambiguous_corners: corners that several vertices of one octagon claim; they count as missing.
    """

    gids: Int64[np.ndarray, " m"]
    corners_world: Float64[np.ndarray, "m 8 3"]
    present: Bool[np.ndarray, "m 8"]
    is_copy: Bool[np.ndarray, " m"]
    matched_by: str
    foreign_vertices: int
    ambiguous_corners: int

    def __len__(self) -> int:
        return len(self.gids)

    def nearest_first(self, distances: Float[np.ndarray, " m"]) -> "Octagons":
        """Of several octagons of one Gaussian, the one with the least of ``distances`` is the original."""
        order = np.lexsort((distances, self.gids))
        gids = self.gids[order]
        is_copy = np.concatenate([[False], gids[1:] == gids[:-1]])
        return replace(
            self,
            gids=gids,
            corners_world=self.corners_world[order],
            present=self.present[order],
            is_copy=is_copy,
        )


def match_octagons(
    path: Path, mesh: Mesh, opacities: Float[np.ndarray, " n"], radii: Float[np.ndarray, " n"]
) -> Octagons:
    """Find the octagons of ``mesh``: by the vertex attributes for Gaussian and corner, else by order.

    Args:
        path: names the mesh in errors.
        mesh: as read.
        opacities: of the unedited scene's Gaussians.
        radii: corner radii that their octagons were exported with, in standard deviations; 0 without octagon.

    Raises:
        SceneFileError: the mesh has no ids and its vertices are not those exported, in their order; or its
            ids are those of another scene.
    """
    if mesh.gid is not None and mesh.corner is not None:
        return _match_by_ids(path, mesh, mesh.gid, mesh.corner, radii)
    return _match_by_order(path, mesh, opacities, radii)


def _match_by_ids(path: Path, mesh: Mesh, gid: np.ndarray, corner: np.ndarray, radii: np.ndarray) -> Octagons:
    scene_size = len(radii)
    with np.errstate(invalid="ignore"):
        whole = (np.abs(gid - np.round(gid)) < ID_TOLERANCE) & (
            np.abs(corner - np.round(corner)) < ID_TOLERANCE
        )
        known: np.ndarray = whole & (gid > -0.5) & (corner > -0.5) & (corner < SIDES - 0.5)
    if known.any() and gid[known].max() > scene_size - 0.5:
        raise SceneFileError(
            f"{path}: numbers a Gaussian {int(gid[known].max())}, but the scene has {scene_size}; "
            "name the scene that the mesh was exported from."
        )
    vertices = np.flatnonzero(known)
    keys = np.round(gid[vertices]).astype(np.int64) * SIDES + np.round(corner[vertices]).astype(np.int64)
    keys, positions, node_of_vertex = _unite_split_vertices(len(mesh), vertices, keys, mesh.vertices)
    if not len(keys):
        raise SceneFileError(f"{path}: none of its vertices carries the number of a Gaussian and a corner.")
    instance = _instances(keys, node_of_vertex, mesh.triangles)
    octagons = _assemble(keys, positions, instance)
    gids, corners, present, ambiguous = octagons
    # Vertices that another object brought when it was joined carry zeros, not ids of their own.
    first = np.concatenate([[True], gids[1:] != gids[:-1]])
    enough = present.sum(axis=1) >= LEAST_CORNERS
    kept = first | enough
    united = len(vertices)
    foreign = len(mesh) - united + int(present[~kept].sum())
    return Octagons(gids[kept], corners[kept], present[kept], ~first[kept], "ids", foreign, ambiguous)


def _unite_split_vertices(
    count: int, vertices: np.ndarray, keys: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices that share corner and place are one: GLB splits them where normals or seams differ.

    Returns:
        Keys and positions of the united vertices, sorted by key, and the united vertex of each vertex (-1:
        none).
    """
    places = positions[vertices]
    order = np.lexsort((places[:, 2], places[:, 1], places[:, 0], keys))
    keys, places, vertices = keys[order], places[order], vertices[order]
    new = np.ones(len(keys), dtype=bool)
    new[1:] = (keys[1:] != keys[:-1]) | (places[1:] != places[:-1]).any(axis=1)
    node_of_vertex = np.full(count, -1, np.int64)
    node_of_vertex[vertices] = np.cumsum(new) - 1
    return keys[new], places[new], node_of_vertex


def _instances(
    keys: Int64[np.ndarray, " u"], node_of_vertex: np.ndarray, triangles: Int64[np.ndarray, "t 3"]
) -> Int64[np.ndarray, " u"]:
    """A number for the octagon that each united vertex is part of.

    All vertices of a Gaussian are one octagon, unless some corner is there twice: then each connected part is
    an octagon of its own, which is what duplicating in an editor makes.
    """
    gids = keys // SIDES
    instance = gids.copy()
    twice = np.zeros(len(keys), dtype=bool)
    twice[1:] = keys[1:] == keys[:-1]
    doubled = np.isin(gids, np.unique(gids[twice]))
    if not doubled.any():
        return instance
    corners = node_of_vertex[triangles]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    edges = edges[(edges >= 0).all(axis=1)]
    edges = edges[(gids[edges[:, 0]] == gids[edges[:, 1]]) & doubled[edges[:, 0]]]
    ones = np.ones(len(edges), dtype=np.int8)
    graph = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(len(keys), len(keys)))
    _, parts = connected_components(graph, directed=False)
    instance[doubled] = len(keys) + gids.max() + 1 + parts[doubled]
    return instance


def _assemble(
    keys: Int64[np.ndarray, " u"], positions: np.ndarray, instance: Int64[np.ndarray, " u"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Octagons in order of Gaussian, then the most complete first, and the number of ambiguous corners."""
    _, numbers = np.unique(instance, return_inverse=True)
    count = int(numbers.max()) + 1
    gids = np.zeros(count, np.int64)
    gids[numbers] = keys // SIDES
    claims = np.zeros((count, SIDES), np.int64)
    np.add.at(claims, (numbers, keys % SIDES), 1)
    corners = np.zeros((count, SIDES, 3))
    corners[numbers, keys % SIDES] = positions
    present = claims == 1
    corners[~present] = 0.0
    first_vertex = np.full(count, len(keys))
    np.minimum.at(first_vertex, numbers, np.arange(len(keys)))
    order = np.lexsort((first_vertex, -present.sum(axis=1), gids))
    return gids[order], corners[order], present[order], int((claims > 1).sum())


def _match_by_order(path: Path, mesh: Mesh, opacities: np.ndarray, radii: np.ndarray) -> Octagons:
    expected = int((radii > 0).sum())
    count, rest = divmod(len(mesh), SIDES)
    if rest or not 0 < count <= expected:
        raise SceneFileError(
            f"{path}: cannot be matched to the scene; its vertices carry no ids (attributes gid and corner), "
            f"and it has {len(mesh)} of them where {expected * SIDES} were exported. {ADVICE}"
        )
    # An export with a least opacity leaves the faintest out.
    faintest = np.sort(opacities[radii > 0])[expected - count]
    gids = np.flatnonzero((radii > 0) & (opacities >= faintest))
    if len(gids) != count or not _uv_agree(mesh, radii[gids], radii):
        raise SceneFileError(
            f"{path}: cannot be matched to the scene; its vertices carry no ids (attributes gid and corner), "
            "and their texture coordinates show that their order has changed. {ADVICE}"
        )
    corners = mesh.vertices.reshape(count, SIDES, 3)
    return Octagons(
        gids,
        corners,
        np.ones((count, SIDES), dtype=bool),
        np.zeros(count, dtype=bool),
        "order",
        0,
        0,
    )


def _uv_agree(mesh: Mesh, radii: np.ndarray, all_radii: np.ndarray) -> bool:
    """Whether the texture coordinates are those of octagons in this order; a mesh without them passes."""
    if mesh.uv is None:
        return True
    seen = (mesh.uv.reshape(-1, SIDES, 2) - 0.5).astype(np.float64)
    known = np.logical_and.reduce(np.isfinite(seen), axis=2)
    seen = np.where(known[:, :, None], seen, 0.0)
    # The common factor, the exporter's 1 / sqrt(Q), is fitted: it may not be known here.
    template = radii[:, None, None] * corner_directions()
    for flip in (1.0, -1.0):
        wanted = template * np.array([1.0, flip])
        norm = float(np.sum(wanted[known] ** 2))
        factor = float(np.sum(wanted[known] * seen[known])) / norm if norm else 0.0
        off = np.abs(seen - factor * wanted).max(axis=2)[known]
        if factor > 0.0 and len(off) and off.max() <= UV_TOLERANCE * factor * all_radii.max():
            return True
    return not known.any()
