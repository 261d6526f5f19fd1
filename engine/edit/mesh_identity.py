"""Whether a mesh of octagons was exported from this scene, judged by what an edit leaves alone.

An edit moves octagons and deletes them. It changes neither their radii in standard deviations, which follow
from the opacities of the Gaussians, nor, for most edits, which octagon is larger than which.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.edit.axes import AXIS_ROTATIONS
from octasplat.engine.edit.octagon_matching import ID_TOLERANCE, OTHER_SCENE, MatchedOctagons
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import coordinate_rounding_error, octagon_corners_world
from octasplat.engine.geometry.imported_mesh import ImportedMesh

SAMPLES = 20_000
"""Octagons, and vertices, that are looked at."""
MIN_UNMOVED_SHARE = 0.1
"""So many octagons exactly where the scene has them are no accident."""
RELATED_RATIO = 0.5
"""Differences from the Gaussian of the same number are at most this share of those from any Gaussian."""
MIN_SPREAD = 0.02
"""Values of the scene that spread by less tell no two scenes apart."""


def check_mesh_of_scene(
    path: Path,
    mesh: ImportedMesh,
    octagons: MatchedOctagons,
    geometry: FlatGaussians,
    radii: Float[np.ndarray, " n"],
) -> None:
    """Refuse a mesh whose octagons have nothing to do with the Gaussians whose numbers they carry.

    Args:
        path: names the mesh in errors.
        mesh: as read.
        octagons: matched to the Gaussians.
        geometry: the unedited scene.
        radii: of its octagons, in standard deviations; 0 without octagon.

    Raises:
        SceneFileError: it is the mesh of another scene.
    """
    rows = np.unique(np.linspace(0, len(octagons) - 1, SAMPLES).astype(np.int64))
    gids, present = octagons.gids[rows], octagons.present[rows]
    corners = octagons.corners_world[rows]
    unedited = octagon_corners_world(geometry.select(gids), radii[gids]).astype(np.float64)
    if _unmoved_share(corners, unedited, present, mesh.rounding) >= MIN_UNMOVED_SHARE:
        return
    attribute = _is_related(*_squared_radii(mesh, radii, mesh.radius))
    if attribute is None:  # texture coordinates may have been made anew in the editor
        texture = None if mesh.uv is None else 2.0 * np.linalg.norm(mesh.uv - np.float32(0.5), axis=1)
        by_texture = _is_related(*_squared_radii(mesh, radii, texture))
        by_size = _is_related(*_log_sizes(corners, unedited, present, geometry, radii))
        related = by_texture or by_size or (by_texture is None and by_size is None)
    else:
        related = attribute
    if not related:
        deleted = int((radii > 0).sum()) - len(np.unique(octagons.gids))
        raise SceneFileError(
            f"{path}: its octagons differ from those of the scene in size and shape, and "
            f"{max(deleted, 0):,} of {len(radii):,} Gaussians would be deleted; it {OTHER_SCENE}."
        )


def _unmoved_share(
    corners: Float64[np.ndarray, "m 8 3"],
    unedited: Float64[np.ndarray, "m 8 3"],
    present: Bool[np.ndarray, "m 8"],
    file_rounding: float,
) -> float:
    """Return the share of octagons all of whose corners are as exported, along whichever axes do best."""
    rounding = coordinate_rounding_error(unedited.astype(np.float32)).astype(np.float64) + 2 * file_rounding
    shares = []
    for turn in AXIS_ROTATIONS.values():
        moves = np.where(present[:, :, None], np.abs(corners @ turn.T - unedited), 0.0)
        shares.append(float((present.any(axis=1) & (moves.max(axis=(1, 2)) <= rounding)).mean()))
    return max(shares)


def _squared_radii(
    mesh: ImportedMesh, radii: Float[np.ndarray, " n"], found: Float[np.ndarray, " v"] | None
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"], Float64[np.ndarray, " e"]]:
    """Return squared radii of some vertices: in the mesh, of their Gaussians and of all Gaussians.

    They differ by a constant where the export had another Q.
    """
    everyone = radii[radii > 0].astype(np.float64) ** 2
    if mesh.gid is None or found is None:
        return np.zeros(0), np.zeros(0), everyone
    with np.errstate(invalid="ignore"):
        known = np.isfinite(found) & (mesh.gid > -0.5) & (mesh.gid < len(radii) - 0.5)
        known &= np.abs(mesh.gid - np.round(mesh.gid)) < ID_TOLERANCE
    vertices = np.flatnonzero(known)
    if len(vertices) > SAMPLES:
        vertices = vertices[np.linspace(0, len(vertices) - 1, SAMPLES).astype(np.int64)]
    expected = radii[np.round(mesh.gid[vertices]).astype(np.int64)].astype(np.float64) ** 2
    return found[vertices].astype(np.float64) ** 2, expected, everyone


def _log_sizes(
    corners: Float64[np.ndarray, "m 8 3"],
    unedited: Float64[np.ndarray, "m 8 3"],
    present: Bool[np.ndarray, "m 8"],
    geometry: FlatGaussians,
    radii: Float[np.ndarray, " n"],
) -> tuple[Float64[np.ndarray, " k"], Float64[np.ndarray, " k"], Float64[np.ndarray, " e"]]:
    """Return logarithms of sizes of octagons: in the mesh, of their Gaussians and of all Gaussians."""
    found, expected = _sizes(corners, present), _sizes(unedited, present)
    some = np.flatnonzero(radii > 0)
    some = some[np.unique(np.linspace(0, len(some) - 1, SAMPLES).astype(np.int64))]
    everyone = octagon_corners_world(geometry.select(some), radii[some]).astype(np.float64)
    sizes = _sizes(everyone, np.ones(everyone.shape[:2], dtype=bool))
    usable = (present.sum(axis=1) > 2) & (found > 0) & (expected > 0)
    return np.log(found[usable]), np.log(expected[usable]), np.log(sizes[sizes > 0])


def _sizes(
    corners: Float64[np.ndarray, "m 8 3"], present: Bool[np.ndarray, "m 8"]
) -> Float64[np.ndarray, " m"]:
    """Return the root of the summed squared distances of the corners from their centre."""
    count = np.maximum(present.sum(axis=1), 1)
    masked = np.where(present[:, :, None], corners, 0.0)
    centres = masked.sum(axis=1) / count[:, None]
    offsets = np.where(present[:, :, None], corners - centres[:, None], 0.0)
    return np.asarray(np.sqrt((offsets**2).sum(axis=(1, 2)) / count))


def _is_related(
    found: Float64[np.ndarray, " k"], expected: Float64[np.ndarray, " k"], everyone: Float64[np.ndarray, " e"]
) -> bool | None:
    """Return whether values follow those expected, up to a constant; None where that cannot be told."""
    if not len(found) or not len(everyone):
        return None
    chosen: Int64[np.ndarray, " k"] = np.random.default_rng(0).integers(len(everyone), size=len(found))
    by_chance = _spread(found - everyone[chosen])
    if _spread(everyone) < MIN_SPREAD or by_chance < MIN_SPREAD:
        return None
    return _spread(found - expected) <= RELATED_RATIO * by_chance


def _spread(values: Float64[np.ndarray, " k"]) -> float:
    return float(np.median(np.abs(values - np.median(values))))
