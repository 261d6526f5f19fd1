"""Gaussians from the octagons of an edited mesh (paper section 3.3, by least squares over all corners)."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.edit.axes import AXIS_ROTATIONS, default_axes, detect_axes
from octasplat.engine.edit.edit_options import MeshToGaussiansOptions
from octasplat.engine.edit.exported_radii import exported_radii
from octasplat.engine.edit.mesh_identity import check_mesh_of_scene
from octasplat.engine.edit.neighbors import interpolate_motion, is_flipped, neighbour_rotations
from octasplat.engine.edit.octagon_fit import MIN_CORNERS, fit_octagons
from octasplat.engine.edit.octagon_matching import MatchedOctagons, match_octagons
from octasplat.engine.edit.reports import EditReport
from octasplat.engine.files import ImportedMesh
from octasplat.engine.gaussians.apply_legs import apply_legs_to, row_blocks
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.legs import has_area, legs_world, volume_derivatives
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.gaussians.octagon import (
    coordinate_rounding_error,
    frames_from_octagons,
    octagon_corners_world,
)

STRAINED_RATIO = 0.3
"""Residual, in standard deviations, above which one Gaussian is a coarse stand-in for what the edit made."""
TORN_RATIO = 0.5
"""Of an octagon's largest radius: corners of which some stayed and one moved further are not one surface."""
AXES_SAMPLES = 100_000
"""Octagons that are looked at to find turned axes."""


@dataclass
class _RecoveredParameters:
    """New parameters, one row an octagon, and what is known about each."""

    means: Float64[np.ndarray, "m 3"]
    legs: Float64[np.ndarray, "m 3 2"]
    signs: Float64[np.ndarray, " m"]
    unmoved: Bool[np.ndarray, " m"]
    readable: Bool[np.ndarray, " m"]
    damaged: Bool[np.ndarray, " m"] = field(default_factory=lambda: np.zeros(0, dtype=bool))


def recover_gaussians(
    gaussians: FlatGaussians, mesh: ImportedMesh, path: Path, options: MeshToGaussiansOptions | None = None
) -> tuple[FlatGaussians, EditReport]:
    """Return the scene that an edited octagon mesh describes.

    Gaussians of which no corner moved keep every bit. Of the others the centre, frame and scales follow the
    corners, the harmonics turn with the surface, and opacity stays.

    Args:
        gaussians: the scene that the mesh was exported from.
        mesh: the edited mesh.
        path: its file, named in errors; its suffix says which axes are usual.
        options: see there.

    Raises:
        SceneFileError: the mesh does not belong to the scene, is only a part of it, its vertices cannot be
            identified, or nothing is left of the scene.
    """
    if mesh.part is not None:  # what lies in the others would count as deleted
        raise SceneFileError(
            f"{path}: is part {mesh.part[0]} of the {mesh.part[1]} files of its scene; export it as PLY to "
            "edit it, or join all parts in the editor."
        )
    options = options or MeshToGaussiansOptions()
    opacities = gaussians.opacities
    q, radii = exported_radii(mesh, opacities, options.q)
    octagons = match_octagons(path, mesh, opacities, radii)
    geometry = gaussians.with_base_color_only()
    check_mesh_of_scene(path, mesh, octagons, geometry, radii)
    file_rounding = mesh.rounding
    requested, stated = options.min_opacity, mesh.min_opacity
    exported = (radii > 0) & (opacities >= ((stated or 0.0) if requested is None else requested))
    if octagons.matched_by == "order":  # of which none is missing: what has no octagon was not exported
        exported = np.zeros(len(gaussians), dtype=bool)
        exported[octagons.gids] = True
    del mesh  # the largest thing around, where the caller keeps it no longer
    report = EditReport(len(gaussians), matched_by=octagons.matched_by, axes_usual=default_axes(path), q=q)
    if options.axes == "auto":
        some = np.unique(np.linspace(0, len(octagons) - 1, AXES_SAMPLES).astype(np.int64))
        unedited = octagon_corners_world(geometry.select(octagons.gids[some]), radii[octagons.gids[some]])
        corners, present = octagons.corners_world[some], octagons.present[some]
        report.axes = detect_axes(default_axes(path), corners, present, unedited)
    else:
        report.axes = options.axes
    if report.axes != "x0":
        octagons = replace(octagons, corners_world=octagons.corners_world @ AXIS_ROTATIONS[report.axes].T)
    # Of several octagons of a Gaussian, that nearest to where it was exported is the original.
    if octagons.is_copy.any():
        octagons = octagons.prefer_nearest(_mean_displacements(geometry, octagons, radii))
    old = geometry.select(octagons.gids)
    recovered = _recover_parameters(
        old=old,
        octagons=octagons,
        radii=radii[octagons.gids],
        file_rounding=file_rounding,
        options=options,
        report=report,
    )
    result = _assemble(
        gaussians=gaussians,
        old=old,
        octagons=octagons,
        recovered=recovered,
        exported=exported,
        options=options,
        report=report,
    )
    report.foreign_vertices = octagons.foreign_vertices
    report.ambiguous_corners = octagons.ambiguous_corners
    report.result_size = len(result)
    if len(result) == 0:
        raise SceneFileError(f"{path}: nothing is left of the scene after this edit.")
    return result, report


def _mean_displacements(
    geometry: FlatGaussians, octagons: MatchedOctagons, radii: Float[np.ndarray, " n"]
) -> Float64[np.ndarray, " m"]:
    """Return the mean displacement of each octagon's corners since the export, world units."""
    result = np.empty(len(octagons))
    for block in row_blocks(len(octagons)):
        gids = octagons.gids[block]
        unedited = octagon_corners_world(geometry.select(gids), radii[gids])
        moves = np.linalg.norm(octagons.corners_world[block] - unedited, axis=2)
        result[block] = moves.mean(axis=1, where=octagons.present[block])
    return result


def _recover_parameters(
    old: FlatGaussians,
    octagons: MatchedOctagons,
    radii: Float[np.ndarray, " m"],
    file_rounding: float,
    options: MeshToGaussiansOptions,
    report: EditReport,
) -> _RecoveredParameters:
    count = len(octagons)
    means, legs, residuals = np.empty((count, 3)), np.empty((count, 3, 2)), np.empty(count)
    unmoved, readable, crumpled = (np.empty(count, dtype=bool) for _ in range(3))
    for block in row_blocks(count):
        part, radius = old.select(block), radii[block]
        corners, present = octagons.corners_world[block], octagons.present[block]
        unedited = octagon_corners_world(part, radius)
        moves = np.where(present[:, :, None], corners - unedited, 0.0)
        rounding = coordinate_rounding_error(unedited).astype(np.float64) + 2 * file_rounding
        torn, is_moved = _torn_octagons(moves, present, part, radius, rounding)
        report.partial += int(torn.sum())
        if options.whole_octagons and torn.any():
            report.snapped += int(torn.sum())
            # A torn octagon follows the greater part of its corners.
            follows = torn & (2 * (is_moved & present).sum(axis=1) >= present.sum(axis=1))
            present = np.where(follows[:, None], present & is_moved, present)
            moves[(torn & ~follows)] = 0.0
        stayed = present.any(axis=1) & (np.abs(moves).max(axis=(1, 2)) <= rounding)
        fit = fit_octagons(part, moves, present, radius)
        new_means, new_legs = fit.means_world, fit.legs_world
        enough = present.sum(axis=1) >= MIN_CORNERS
        if options.method == "three-point":
            new_means, new_legs, enough = _three_point(corners, present, radius, part)
        new_rounding = np.abs(new_means).max(axis=1) * 2 * np.finfo(np.float32).eps + 2 * file_rounding
        sound = has_area(new_legs, new_rounding / np.maximum(radius, 1e-3)) & (radius > 0)
        bad = enough & ~stayed & (~sound | fit.is_folded | (fit.residuals > options.max_residual))
        means[block], legs[block], residuals[block] = new_means, new_legs, fit.residuals
        unmoved[block], crumpled[block] = stayed, bad
        readable[block] = stayed | (enough & sound & ~bad)
    complete = octagons.present.all(axis=1)
    judged = readable & ~unmoved
    signs, flipped, mirrored = _normal_signs(old, means, legs, judged, octagons)
    if options.damaged == "repair":
        signs = np.where(flipped, -signs, signs)
    report.unmoved = int((unmoved & ~octagons.is_copy).sum())
    report.moved = int((judged & ~octagons.is_copy).sum())
    report.incomplete = int((~complete).sum())
    report.crumpled = int(crumpled.sum())
    report.flipped, report.mirrored = int(flipped.sum()), int(mirrored.sum())
    if judged.any():
        known = residuals[judged]
        report.strained = int((known > STRAINED_RATIO).sum())
        report.residual_median, report.residual_p95 = np.quantile(known, [0.5, 0.95]).tolist()
        report.residual_max = float(known.max())
    return _RecoveredParameters(
        means=means,
        legs=legs,
        signs=signs,
        unmoved=unmoved,
        readable=readable,
        damaged=~complete | crumpled | flipped,
    )


def _torn_octagons(
    moves: Float64[np.ndarray, "m 8 3"],
    present: Bool[np.ndarray, "m 8"],
    old: FlatGaussians,
    radii: Float[np.ndarray, " m"],
    rounding: Float64[np.ndarray, " m"],
) -> tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, "m 8"]]:
    """Return octagons of which only some corners were moved, and which corners those are.

    Those of a smooth deformation that ends on them are none: their corners move by less than their size.
    """
    lengths = np.linalg.norm(moves, axis=2)
    is_moved = lengths > rounding[:, None]
    size = radii * old.scales.max(axis=1)
    far = np.where(present, lengths, 0.0).max(axis=1) > TORN_RATIO * size
    return far & (present & ~is_moved).any(axis=1), is_moved


def _three_point(
    corners: Float64[np.ndarray, "m 8 3"],
    present: Bool[np.ndarray, "m 8"],
    radii: Float[np.ndarray, " m"],
    old: FlatGaussians,
) -> tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3 2"], Bool[np.ndarray, " m"]]:
    """Recover by the paper's rule: centre from corners 2 and 6, axes from 0 and 2 by Gram-Schmidt."""
    means, quats, log_scales, good = frames_from_octagons(corners, radii.astype(np.float64))
    legs = rotation_matrices(quats)[:, :, 1:] * np.exp(log_scales)[:, None, :]
    enough = present[:, 0] & present[:, 2] & present[:, 6]
    bad = ~(good & enough)
    means[bad], legs[bad] = old.means_world[bad], legs_world(old)[bad]
    return means, legs, enough


def _normal_signs(
    old: FlatGaussians,
    means: Float64[np.ndarray, "m 3"],
    legs: Float64[np.ndarray, "m 3 2"],
    requested: Bool[np.ndarray, " m"],
    octagons: MatchedOctagons,
) -> tuple[Float64[np.ndarray, " m"], Bool[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Return the normals' signs and which Gaussians flipped or were mirrored, judged by their neighbours.

    Originals are judged among originals. Copies are judged among copies, unless a Gaussian was copied more
    than once, where neighbours may belong to different copies.
    """
    signs = np.ones(len(old))
    flipped = np.zeros(len(old), dtype=bool)
    mirrored = np.zeros(len(old), dtype=bool)
    copied = octagons.gids[octagons.is_copy]
    groups = [~octagons.is_copy]
    if len(np.unique(copied)) == len(copied):
        groups.append(octagons.is_copy)
    complete = octagons.present.sum(axis=1) >= MIN_CORNERS
    for group in groups:
        members = np.flatnonzero(group & complete)
        wanted = np.flatnonzero(requested[members])
        if not len(wanted):
            continue
        turns = neighbour_rotations(old.means_world[members].astype(np.float64), means[members], wanted)
        for block in row_blocks(len(wanted)):
            rows = members[wanted[block]]
            normals = rotation_matrices(old.quats_wxyz[rows].astype(np.float64))[:, :, 0]
            new_normals = np.cross(legs[rows, :, 0], legs[rows, :, 1])
            new_normals /= np.maximum(np.linalg.norm(new_normals, axis=-1, keepdims=True), 1e-300)
            flipped[rows], mirrored[rows] = is_flipped(turns[block], normals, new_normals)
            signs[rows] = np.where(mirrored[rows], -1.0, 1.0)
    return signs, flipped, mirrored


def _assemble(
    gaussians: FlatGaussians,
    old: FlatGaussians,
    octagons: MatchedOctagons,
    recovered: _RecoveredParameters,
    exported: Bool[np.ndarray, " n"],
    options: MeshToGaussiansOptions,
    report: EditReport,
) -> FlatGaussians:
    """Return the recovered Gaussians in the order of the scene, copies last."""
    originals = np.flatnonzero(~octagons.is_copy)
    gids = octagons.gids
    absent = np.ones(len(gaussians), dtype=bool)
    absent[gids] = False
    # What has no octagon in the mesh either never had one, or was deleted in the editor.
    never, deleted = absent & ~exported, absent & exported
    report.deleted = int(deleted.sum())
    is_retained = np.ones(len(octagons), dtype=bool)
    if options.damaged == "drop":
        is_retained &= ~recovered.damaged & recovered.readable
    unreadable = np.flatnonzero(~recovered.readable & is_retained)
    # Rows: octagons, then the Gaussians that never had one.
    rest = np.flatnonzero(never)
    pool = originals[recovered.readable[originals]]
    base = concatenate([old.select(unreadable), gaussians.with_base_color_only().select(rest)])

    def derivatives_of(known: Int64[np.ndarray, " k"]) -> Float64[np.ndarray, "k 3 3"]:
        rows = pool[known]
        return volume_derivatives(old.select(rows), recovered.legs[rows], recovered.signs[rows])

    moved = interpolate_motion(
        points=base.means_world.astype(np.float64),
        old_means=old.means_world[pool].astype(np.float64),
        new_means=recovered.means[pool],
        derivatives_of=derivatives_of,
        unmoved=recovered.unmoved[pool],
        deleted_means=gaussians.means_world[deleted].astype(np.float64),
    )
    own = np.flatnonzero(recovered.readable & is_retained)
    # An octagon that is in the mesh was not deleted, even where its nearest neighbor was.
    orphaned = moved.orphaned.copy()
    orphaned[: len(unreadable)] = False
    report.orphaned = int(orphaned.sum())
    report.carried = int((~orphaned[len(unreadable) :]).sum())
    report.dropped = int((~is_retained).sum())
    report.copies = int((octagons.is_copy & is_retained).sum())
    places = np.concatenate([gids[own], gids[unreadable], rest])
    is_copy = np.concatenate(
        [octagons.is_copy[own], octagons.is_copy[unreadable], np.zeros(len(rest), dtype=bool)]
    )
    left = np.concatenate([np.ones(len(own), dtype=bool), ~orphaned])
    order = np.lexsort((places, is_copy))
    order = order[left[order]]
    # New parameters in the order of the result, then the result itself, changed where something moved.
    means = np.concatenate([recovered.means[own], moved.means_world])[order]
    legs = np.concatenate([recovered.legs[own], moved.derivatives @ legs_world(base)])[order]
    carried_signs = np.where(np.linalg.det(moved.derivatives) < 0, -1.0, 1.0)
    signs = np.concatenate([recovered.signs[own], carried_signs])[order]
    unmoved = np.concatenate([recovered.unmoved[own], moved.unmoved])[order]
    result = gaussians.select(places[order])
    apply_legs_to(result, np.flatnonzero(~unmoved), means, legs, signs)
    return result
