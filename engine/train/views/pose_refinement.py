"""Small corrections of the training views' poses, learnt while the Gaussians are.

Between iterations each training view is aligned with what the Gaussians show from there (see
:mod:`octasplat.engine.train.views.image_alignment`); rays are then made from the corrected poses, and both
come nearer by turns. What all corrections have in common is taken out, so that held-out views, which keep the
poses that are given, stay in their places. Poses that are wrong by more than some pixels are not found: steps
are small, and nothing is looked for. The first Gaussians, camera clearance, least scales, meshes and renders
"as the photographs" use the poses that are given, and so do later commands; ``training.json`` has the
corrected ones.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.dataset.view_frusta import rotate_vectors
from octasplat.engine.shading.protocol import ShadingModel, TracedRays
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.sampling.batches import grid_pixels
from octasplat.engine.train.sampling.pixel_sampler import TrainingData, view_sizes_px
from octasplat.engine.train.views.corrected_views import (
    CorrectedDataset,
    PosedTrainingData,
    remove_common_motion,
)
from octasplat.engine.train.views.image_alignment import (
    RenderedPoints,
    RigidMotion,
    align_camera,
    photograph_spline,
)

GRID_TILES = 5
"""So many tiles each way of a view are aligned.

See :func:`octasplat.engine.train.sampling.batches.grid_pixels`.
"""
VIEWS_PER_TRACE = 32
STEP_FRACTION = 0.5
"""Share of a motion that is taken: what the Gaussians get wrong for the moment is averaged out."""
MIN_ALPHA = 0.7
"""Least accumulated alpha of a ray that is taken to meet the surface."""


@dataclass(frozen=True)
class RefinedPose:
    """A pose after the training, in the frame of the one that was given.

    Attributes:
        rotation_cam_from_world: rows of the corrected rotation.
        translation_cam_from_world: world units.
        turned_deg: by how much the camera was turned.
        shifted_world: by how much its centre was moved.
        moved_px: by how much the middle one of its points moves in the picture; None where there are none.
    """

    rotation_cam_from_world: list[list[float]]
    translation_cam_from_world: list[float]
    turned_deg: float
    shifted_world: float
    moved_px: float | None


@dataclass(frozen=True)
class RefinedPoses:
    """The poses of training views whose poses were corrected, by name, among so many that were trained on."""

    views: dict[str, RefinedPose]
    of: int

    def as_dict(self) -> dict[str, dict[str, object]]:
        """Return a JSON-ready record, by name."""
        return {name: dict(vars(pose)) for name, pose in self.views.items()}

    def summary(self) -> str:
        """Return a sentence on how far poses were moved."""
        sizes = {name: pose.moved_px for name, pose in self.views.items() if pose.moved_px is not None}
        middle = float(np.median(list(sizes.values()))) if sizes else 0.0
        if not sizes:
            return f"The poses of all {self.of} training views stayed as they were given."
        largest = max(sizes, key=lambda name: sizes[name])
        return (
            f"The poses of {len(self.views)} of {self.of} training views were corrected, by {middle:.2f} px "
            f"in the middle and {sizes[largest]:.2f} px at most ({largest})."
        )


class PoseRefiner:
    """Aligns the training views.

    Args:
        dataset: the photographs with the poses that are given.
        background_srgb: what is behind them.

    Attributes:
        dataset: the photographs as they are to be trained on.
    """

    def __init__(self, dataset: PosedTrainingData, background_srgb: Float32[np.ndarray, "3"]) -> None:
        self.dataset = CorrectedDataset(dataset)
        self._background_srgb = background_srgb

    def refine(
        self,
        corrections: Float64[np.ndarray, "v 6"],
        tracer: Tracer,
        shading: ShadingModel,
        left_out: Int64[np.ndarray, " m"],
    ) -> Float64[np.ndarray, "v 6"]:
        """Return the corrections after one more alignment of the views with the Gaussians of ``tracer``.

        Views that show too little, or agree no better afterwards, stay as they are, and so do those left out.
        """
        dataset, found = self.dataset, corrections.copy()
        used = np.setdiff1d(dataset.train_indices, left_out)
        for index, rendered in self._render_grids(used, tracer, shading):
            view = dataset.views[index]
            size_px = (view.width_px, view.height_px)
            photograph = photograph_spline(dataset, index, size_px, self._background_srgb)
            motion = align_camera(rendered, photograph, dataset.cameras[view.camera_index])
            # a share of the motion, on top of the present correction
            if motion is not None:
                found[index] = (
                    motion.scaled(STEP_FRACTION).compose(RigidMotion.from_vector(found[index])).to_vector
                )
        found = remove_common_motion(found, dataset.original, used)
        dataset.set_corrections(found)
        return found

    def report(
        self,
        corrections: Float64[np.ndarray, "v 6"],
        tracer: Tracer,
        shading: ShadingModel,
        left_out: Int64[np.ndarray, " m"],
    ) -> RefinedPoses:
        """Return the corrected poses, and how much they differ in the pictures of the finished Gaussians."""
        dataset, found = self.dataset, {}
        used = np.setdiff1d(dataset.train_indices, left_out)
        moved = used[corrections[used].any(axis=1)]
        for index, rendered in self._render_grids(moved, tracer, shading):
            view, given = dataset.views[index], dataset.original.views[index]
            camera, motion = dataset.cameras[view.camera_index], RigidMotion.from_vector(corrections[index])
            points = rendered.points_cam
            away = np.linalg.norm(camera.project(points) - camera.project(motion.inverse(points)), axis=1)
            away = away[np.isfinite(away)]
            found[view.name] = RefinedPose(
                rotation_cam_from_world=view.rotation_cam_from_world.tolist(),
                translation_cam_from_world=view.translation_cam_from_world.tolist(),
                turned_deg=float(np.degrees(np.linalg.norm(corrections[index, :3]))),
                shifted_world=float(np.linalg.norm(view.origin_world - given.origin_world)),
                moved_px=float(np.median(away)) if len(away) else None,
            )
        return RefinedPoses(found, len(used))

    def _render_grids(
        self, indices: Int64[np.ndarray, " v"], tracer: Tracer, shading: ShadingModel
    ) -> Iterator[tuple[int, RenderedPoints]]:
        """Yield each view with what the Gaussians show of a grid of its pixels, where they show a surface."""
        dataset = self.dataset
        for start in range(0, len(indices), VIEWS_PER_TRACE):
            part = indices[start : start + VIEWS_PER_TRACE]
            view, y, x = grid_pixels(part, view_sizes_px(dataset), GRID_TILES)
            rays = dataset.rays(view, y, x)
            result = tracer.trace(rays)
            shaded = shading.shade(TracedRays(rays, result, tracer, view))
            rgb = np.clip(shaded.composite_over(self._background_srgb), 0, 1)
            # haze has no depth to align by
            has_surface = (result.depth_median > 0) & (result.alpha >= MIN_ALPHA)
            points_world = result.depth_median[:, None].astype(np.float64) * rays.directions_world
            for index in part.tolist():
                chosen = has_surface & (view == index)
                points = rotate_vectors(points_world[chosen], dataset.views[index].rotation_cam_from_world)
                yield index, RenderedPoints(points, rgb[chosen].astype(np.float64))


def make_pose_refiner(dataset: TrainingData, background_srgb: Float32[np.ndarray, "3"]) -> PoseRefiner:
    """Return a refiner of the training views' poses.

    Raises:
        ConfigError: the photographs come without cameras.
    """
    if not isinstance(dataset, PosedTrainingData):
        raise ConfigError("refine_poses projects into the photographs, but these come without cameras.")
    return PoseRefiner(dataset, background_srgb)
