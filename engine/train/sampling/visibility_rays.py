"""What photographs see of the sparse points: nothing stands between a camera and a point that it shows.

A point was matched in each photograph of its track, so the way there is free. Haze and floaters that
photographs leave undecided, and whatever fills the gap under a thing that stands on a mirror, are in the way
of such points. Rays to them are traced beside the rays of each batch, almost as far as their points,
and what hides these costs.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64, Int64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.model import DatasetView, Observations, SparsePoints
from octasplat.engine.trace.protocol import Recording, TraceGradients, Tracer

MIN_TRACK_LENGTH = 3
"""Points in fewer training views may be wrong matches."""
MAX_ERROR_SIGMAS = 3.0
"""A ray ends so many standard deviations of its depth before its point."""
MIN_ERROR_PX = 0.5
"""No point is placed better than that."""


@runtime_checkable
class ObservedPoints(Protocol):
    """Photographs with the points that they show, and where these lie.

    See :class:`octasplat.engine.dataset.Dataset`.
    """

    views: tuple[DatasetView, ...]
    cameras: tuple[Camera, ...]
    train_indices: Int64[np.ndarray, " t"]
    points: SparsePoints
    observations: Observations


@dataclass(frozen=True)
class VisibilityRays:
    """Ways from training cameras to the points that they show.

    Attributes:
        starts_world: the cameras.
        directions_world: unit vectors.
        ends: where each way ends, world units from the camera.
        view: index of the camera's view.
    """

    starts_world: Float64[np.ndarray, "k 3"]
    directions_world: Float64[np.ndarray, "k 3"]
    ends: Float64[np.ndarray, " k"]
    view: Int64[np.ndarray, " k"]

    def __len__(self) -> int:
        return len(self.ends)

    @classmethod
    def from_dataset(cls, dataset: ObservedPoints, margin: float) -> "VisibilityRays":
        """Return the visibility rays of the training views.

        The depth of a point along one ray of its track is known to
        ``error / sqrt(sum over the other rays of sin^2 of the angle between)``, with the reprojection error
        at its distance; each way ends three of these before the point, or ``margin`` of the distance. Poses
        are those of the model, also where they are refined; errors count as pixels of the working size, so
        that sight ends the sooner before points of photographs that were made smaller.
        """
        observations, points = dataset.observations, dataset.points
        row, is_there = points.rows_of(observations.point)
        keep = np.isin(observations.view, dataset.train_indices) & is_there
        row, view = row[keep], observations.view[keep]
        origins = np.stack([each.origin_world for each in dataset.views])
        offset = points.xyz_world[row].astype(np.float64) - origins[view]
        distance = np.linalg.norm(offset, axis=1)
        direction = offset / np.maximum(distance, 1e-12)[:, None]
        outer = np.zeros((len(points), 3, 3))
        np.add.at(outer, row, direction[:, :, None] * direction[:, None, :])
        track = np.bincount(row, minlength=len(points))
        # Sum of squared cosines to all rays of the track, itself with 1.
        own_cosines = np.einsum("ki,kij,kj->k", direction, outer[row], direction)
        # sum of squared sines to the other rays of the track
        sharpness = np.sqrt(np.maximum(track[row] - own_cosines, 1e-12))
        pixel_rad = np.array([dataset.cameras[each.camera_index].pixel_angle_rad for each in dataset.views])[
            view
        ]
        error_px = np.maximum(points.errors_px[row], MIN_ERROR_PX)
        deviation = error_px * pixel_rad * distance / sharpness
        ends = distance - np.maximum(MAX_ERROR_SIGMAS * deviation, margin * distance)
        # rays that end early are too uncertain to say anything
        is_usable = (track[row] >= MIN_TRACK_LENGTH) & (ends > 0.5 * distance)
        return cls(origins[view[is_usable]], direction[is_usable], ends[is_usable], view[is_usable])

    def exclude_views(self, views: Int64[np.ndarray, " m"]) -> "VisibilityRays":
        """Return the rays of all other views."""
        is_other = ~np.isin(self.view, views)
        return VisibilityRays(
            self.starts_world[is_other],
            self.directions_world[is_other],
            self.ends[is_other],
            self.view[is_other],
        )

    def draw(self, rng: np.random.Generator, count: int) -> RayBatch:
        """Draw any ``count`` of them, neighbours in the order of the views."""
        chosen = np.sort(rng.integers(0, len(self), count))
        return RayBatch(self.starts_world[chosen], self.directions_world[chosen], t_max=self.ends[chosen])


def free_space_gradient(
    visibility_rays: RayBatch, tracer: Tracer, weight: float, *, min_hidden: float = 0.0
) -> tuple[Recording, TraceGradients]:
    """Return the recording of visibility rays, and gradients of ``weight`` times their mean hidden share.

    Of each ray's hidden share the part above ``min_hidden`` counts: rays that graze the surface are dimmed by
    the tails of the Gaussians that outlines are made of.
    """
    result = tracer.trace(visibility_rays, record=True)
    assert result.recording is not None
    no_color = np.zeros_like(result.rgb_srgb)
    counts = result.alpha >= min_hidden
    # dL/dT: hidden share is 1 - T
    by_transmittance = np.where(counts, np.float32(-weight / len(visibility_rays)), np.float32(0.0))
    return result.recording, TraceGradients(no_color, transmittance=by_transmittance)
