"""Reports of edits: counts of what was found and done."""

from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict

from octasplat.engine.edit.axes import Axes
from octasplat.engine.gaussians.octagon import CHI2_2_99


@dataclass
class EditReport:
    """Counts of an edited mesh; all are numbers of Gaussians unless they say otherwise.

    Attributes:
        scene_size: in the unedited scene.
        result_size: in the result.
        matched_by: ``ids`` or ``order``.
        axes: the turn about x that was applied to the mesh.
        axes_usual: what this kind of file has if it was not converted on its way.
        q: chi-square quantile of the octagons.
        unmoved: kept bit for bit, as no corner moved.
        moved: recovered from their corners.
        deleted: without any vertex left, so left out.
        copies: added, as their octagons were duplicated.
        carried: without an octagon of their own (too faint), moved as their neighbours were.
        orphaned: without an octagon, left out as their nearest neighbour was deleted.
        incomplete: with some corners missing.
        crumpled: folded, without area, or too far from an affine image.
        flipped: facing the other way than their surroundings.
        mirrored: in parts of the scene that were mirrored as a whole.
        dropped: of the damaged ones, left out.
        partial: with some corners that stayed and others that moved far.
        snapped: of these, moved or kept as a whole.
        foreign_vertices: vertices that belong to no octagon.
        ambiguous_corners: corners claimed by several vertices, taken as missing.
        strained: with a residual above 0.3 standard deviations.
        residual_median: median residual of the moved ones, in standard deviations.
        residual_p95: 95th percentile.
        residual_max: largest.
    """

    scene_size: int
    result_size: int = 0
    matched_by: str = ""
    axes: Axes = "x0"
    axes_usual: Axes = "x0"
    q: float = CHI2_2_99
    unmoved: int = 0
    moved: int = 0
    deleted: int = 0
    copies: int = 0
    carried: int = 0
    orphaned: int = 0
    incomplete: int = 0
    crumpled: int = 0
    flipped: int = 0
    mirrored: int = 0
    dropped: int = 0
    partial: int = 0
    snapped: int = 0
    foreign_vertices: int = 0
    ambiguous_corners: int = 0
    strained: int = 0
    residual_median: float = 0.0
    residual_p95: float = 0.0
    residual_max: float = 0.0


@dataclass(frozen=True)
class DeformReport:
    """Counts and figures of a deformation.

    Attributes:
        moved: Gaussians with new parameters.
        unmoved: Gaussians that keep every bit.
        collapsed: moved ones that lost their area; they were placed, with their old frame and size.
        mirrored: moved ones in a part of space that was mirrored.
        residual_median: how far the deformation is from affine over one Gaussian: root mean square distance
            of its corners from the fit, in standard deviations; median of the moved ones.
        residual_p95: 95th percentile.
        residual_max: largest.
    """

    moved: int
    unmoved: int
    collapsed: int
    mirrored: int
    residual_median: float
    residual_p95: float
    residual_max: float


class CleanReport(BaseModel):
    """Counts of the removed Gaussians, each by the first reason that holds.

    Attributes:
        faint: below the least opacity.
        small: below the least scale.
        large: above the largest scale.
        near: nearer to a camera than what its photograph shows.
        unseen: in the images of too few training views.
        floating: in groups too small.
        groups: number of such groups.
        kept: those that stay.
    """

    model_config = ConfigDict(frozen=True)

    faint: int
    small: int
    large: int
    near: int
    unseen: int
    floating: int
    groups: int
    kept: int
