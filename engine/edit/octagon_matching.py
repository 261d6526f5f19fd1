"""Matching of an edited mesh's vertices to the octagon corners of Gaussians."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.edit.octagon_fit import MIN_CORNERS
from octasplat.engine.files import ImportedMesh
from octasplat.engine.gaussians.apply_legs import row_blocks
from octasplat.engine.gaussians.octagon import SIDES, corner_directions

ID_TOLERANCE = 1e-3
"""Numbers that an editor blended between vertices are further than this from whole ones."""
VERTICES_PER_BLOCK = 1 << 18
EXPORT_ADVICE = "Edit the mesh that was exported as PLY and save it as PLY, or the GLB with its attributes."
OTHER_SCENE = "looks like the mesh of another scene; name the scene that it was exported from"
OTHER_ORDER = f"If nothing was added or removed, it {OTHER_SCENE}."
UV_TOLERANCE = 0.02
"""Share of the texture by which coordinates may differ from those exported (some editors keep 16 bits)."""


@dataclass(frozen=True)
class MatchedOctagons:
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

    def prefer_nearest(self, distances: Float[np.ndarray, " m"]) -> "MatchedOctagons":
        """Return the octagons with the least of ``distances`` as the original of each Gaussian."""
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
    path: Path, mesh: ImportedMesh, opacities: Float[np.ndarray, " n"], radii: Float[np.ndarray, " n"]
) -> MatchedOctagons:
    """Find the octagons of ``mesh``: by the vertex attributes for Gaussian and corner, else by order.

    Args:
        path: names the mesh in errors.
        mesh: as read.
        opacities: of the unedited scene's Gaussians.
        radii: corner radii that their octagons were exported with, in standard deviations; 0 without octagon.

    Raises:
        SceneFileError: the mesh has no ids and its vertices are not those exported, in their order; or its
            ids, or the size of the scene that its file states, are those of another scene.
    """
    if mesh.scene_size is not None and mesh.scene_size != len(radii):
        raise SceneFileError(
            f"{path}: was exported from a scene of {mesh.scene_size:,} Gaussians, but the scene has "
            f"{len(radii):,}; it {OTHER_SCENE}."
        )
    if mesh.gid is not None and mesh.corner is not None:
        return _match_by_ids(path, mesh, mesh.gid, mesh.corner, radii)
    return _match_by_order(path, mesh, opacities, radii)


def _match_by_ids(
    path: Path, mesh: ImportedMesh, gid: np.ndarray, corner: np.ndarray, radii: np.ndarray
) -> MatchedOctagons:
    scene_size = len(radii)
    with np.errstate(invalid="ignore"):
        is_valid_id = (np.abs(gid - np.round(gid)) < ID_TOLERANCE) & (
            np.abs(corner - np.round(corner)) < ID_TOLERANCE
        )
        known: np.ndarray = is_valid_id & (gid > -0.5) & (corner > -0.5) & (corner < SIDES - 0.5)
    if known.any() and gid[known].max() > scene_size - 0.5:
        raise SceneFileError(
            f"{path}: numbers a Gaussian {int(gid[known].max())}, but the scene has {scene_size}; "
            f"it {OTHER_SCENE}."
        )
    vertices = np.flatnonzero(known)
    if not len(vertices):
        raise SceneFileError(f"{path}: none of its vertices carries the number of a Gaussian and a corner.")
    keys = np.round(gid[vertices]).astype(np.int64) * SIDES + np.round(corner[vertices]).astype(np.int64)
    united = len(vertices)
    if (keys[1:] > keys[:-1]).all():  # in the order of the export, nothing twice: most edits leave it so
        instance = keys // SIDES
    else:
        keys, vertices, node_of_vertex = _unite_split_vertices(vertices, keys, mesh.vertices)
        instance = _octagon_of_vertex(keys, node_of_vertex, mesh.triangles)
    gids, corners, present, ambiguous = _assemble(keys, mesh.vertices, vertices, instance)
    # Vertices that another object brought when it was joined carry zeros, not ids of their own.
    first = np.concatenate([[True], gids[1:] != gids[:-1]])
    enough = present.sum(axis=1) >= MIN_CORNERS
    is_retained = first | enough
    foreign = len(mesh) - united + int(present[~is_retained].sum())
    if not is_retained.all():
        gids, corners, present, first = (
            gids[is_retained],
            corners[is_retained],
            present[is_retained],
            first[is_retained],
        )
    return MatchedOctagons(
        gids=gids,
        corners_world=corners,
        present=present,
        is_copy=~first,
        matched_by="ids",
        foreign_vertices=foreign,
        ambiguous_corners=ambiguous,
    )


def _unite_split_vertices(
    vertices: Int64[np.ndarray, " k"], keys: Int64[np.ndarray, " k"], positions: Float64[np.ndarray, "v 3"]
) -> tuple[Int64[np.ndarray, " u"], Int64[np.ndarray, " u"], Int32[np.ndarray, " v"]]:
    """Unite vertices of one corner and place: GLB splits them where normals or seams differ.

    Returns:
        Keys of the united vertices in order, one vertex for each, and the united vertex of each vertex (-1:
        none).
    """
    order = np.argsort(keys, kind="stable")
    keys, vertices = keys[order], vertices[order]
    del order
    tied = np.zeros(len(keys), dtype=bool)
    tied[1:] = keys[1:] == keys[:-1]
    tied[:-1] |= tied[1:]
    rows = np.flatnonzero(tied)  # few, so that sorting by place, too, costs little
    places = positions[vertices[rows]]
    by_place = np.lexsort((places[:, 2], places[:, 1], places[:, 0], keys[rows]))
    vertices[rows] = vertices[rows[by_place]]
    places = places[by_place]
    new = np.ones(len(keys), dtype=bool)
    new[rows[1:]] = (keys[rows[1:]] != keys[rows[:-1]]) | (places[1:] != places[:-1]).any(axis=1)
    node_of_vertex = np.full(len(positions), -1, np.int32)
    node_of_vertex[vertices] = np.cumsum(new, dtype=np.int32) - 1
    return keys[new], vertices[new], node_of_vertex


def _octagon_of_vertex(
    keys: Int64[np.ndarray, " u"], node_of_vertex: np.ndarray, triangles: Int64[np.ndarray, "t 3"]
) -> Int64[np.ndarray, " u"]:
    """Return a number for the octagon that each united vertex is part of.

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
    # Two edges are enough to connect the corners of a triangle.
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    edges = edges[(edges >= 0).all(axis=1)]
    edges = edges[(gids[edges[:, 0]] == gids[edges[:, 1]]) & doubled[edges[:, 0]]]
    ones = np.ones(len(edges), dtype=np.int8)
    graph = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(len(keys), len(keys)))
    _, parts = connected_components(graph, directed=False)
    # Numbers that no Gaussian has
    instance[doubled] = len(keys) + gids.max() + 1 + parts[doubled]
    return instance


def _assemble(
    keys: Int64[np.ndarray, " u"],
    positions: Float64[np.ndarray, "v 3"],
    vertices: Int64[np.ndarray, " u"],
    instance: Int64[np.ndarray, " u"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Return octagons by Gaussian, the most complete first, and the number of ambiguous corners."""
    if (instance[1:] >= instance[:-1]).all():  # no need to sort
        numbers = np.zeros(len(instance), np.int64)
        numbers[1:] = np.cumsum(instance[1:] != instance[:-1])
    else:
        _, numbers = np.unique(instance, return_inverse=True)
    count = int(numbers.max()) + 1
    gids = np.zeros(count, np.int64)
    gids[numbers] = keys // SIDES
    first_vertex = np.full(count, len(keys))
    np.minimum.at(first_vertex, numbers, np.arange(len(keys)))
    places = numbers * SIDES + keys % SIDES
    del numbers  # frees a number a vertex
    claims = np.bincount(places, minlength=count * SIDES).reshape(count, SIDES)
    present, ambiguous = claims == 1, int((claims > 1).sum())
    del claims
    order = np.lexsort((first_vertex, -present.sum(axis=1), gids))
    corners = np.zeros((count, SIDES, 3))
    for block in row_blocks(len(places), VERTICES_PER_BLOCK):
        corners.reshape(-1, 3)[places[block]] = positions[vertices[block]]
    corners[~present] = 0.0
    if (order[1:] > order[:-1]).all():
        return gids, corners, present, ambiguous
    return gids[order], corners[order], present[order], ambiguous


def _match_by_order(
    path: Path, mesh: ImportedMesh, opacities: np.ndarray, radii: np.ndarray
) -> MatchedOctagons:
    expected = int((radii > 0).sum())
    count, rest = divmod(len(mesh), SIDES)
    gids = np.zeros(0, np.int64)
    if not rest and 0 < count <= expected:
        # An export with a least opacity leaves the faintest out, and equally faint ones together.
        faintest = np.sort(opacities[radii > 0])[expected - count]
        gids = np.flatnonzero((radii > 0) & (opacities >= faintest))
    if rest or count == 0 or len(gids) != count:
        raise SceneFileError(
            f"{path}: cannot be matched to the scene; its vertices carry no ids (attributes gid and corner), "
            f"and it has {len(mesh)} of them where {expected * SIDES} were exported. {EXPORT_ADVICE} "
            f"{OTHER_ORDER}"
        )
    if not _is_uv_in_order(mesh, radii[gids], radii):
        raise SceneFileError(
            f"{path}: cannot be matched to the scene; its vertices carry no ids (attributes gid and corner), "
            f"and their texture coordinates show that their order has changed. {EXPORT_ADVICE} "
            f"{OTHER_ORDER}"
        )
    corners = mesh.vertices.reshape(count, SIDES, 3)
    return MatchedOctagons(
        gids=gids,
        corners_world=corners,
        present=np.ones((count, SIDES), dtype=bool),
        is_copy=np.zeros(count, dtype=bool),
        matched_by="order",
        foreign_vertices=0,
        ambiguous_corners=0,
    )


def _is_uv_in_order(mesh: ImportedMesh, radii: np.ndarray, all_radii: np.ndarray) -> bool:
    """Return whether the texture coordinates are those of octagons in this order, or absent."""
    if mesh.uv is None:
        return True
    found_uv = mesh.uv.reshape(-1, SIDES, 2)
    # The common factor, the exporter's 1 / sqrt(Q), is fitted: it may not be known here.
    # Formats differ in whether v runs up or down.
    for flip in (1.0, -1.0):
        products = [
            (np.sum(expected * expected), np.sum(expected * here))
            for expected, here in _uv_pairs(found_uv, radii, flip)
        ]
        norm, overlap = np.sum(products, axis=0)
        factor = overlap / norm if norm else 0.0
        if norm == 0.0:
            return True
        if factor > 0.0:
            tolerance = UV_TOLERANCE * factor * all_radii.max()
            pairs = _uv_pairs(found_uv, radii, flip)
            if all(
                np.abs(here - factor * expected).max(initial=0.0) <= tolerance for expected, here in pairs
            ):
                return True
    return False


def _uv_pairs(
    found_uv: Float[np.ndarray, "m 8 2"], radii: Float[np.ndarray, " m"], flip: float
) -> Iterator[tuple[Float64[np.ndarray, "k 2"], Float64[np.ndarray, "k 2"]]]:
    """Return texture coordinates about their centre, block by block: expected up to a factor, and found."""
    for block in row_blocks(len(found_uv)):
        here = found_uv[block].astype(np.float64) - 0.5
        expected = radii[block, None, None] * corner_directions() * np.array([1.0, flip])
        known = np.isfinite(here).all(axis=2)
        yield expected[known], here[known]
