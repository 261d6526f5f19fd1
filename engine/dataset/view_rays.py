"""Rays through the pixels of views: by formula, from tables, or computed one by one."""

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Int64

from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.kernels import gather
from octasplat.engine.dataset.model import DatasetModel
from octasplat.engine.dataset.ray_tables import NO_TABLE_COMPUTED, RayTables, has_rays_everywhere


class ViewRays:
    """Rays of the views of a dataset, in world coordinates.

    Args:
        model: the views and their cameras.
        tables: directions of the cameras that are no pinholes, as far as there are any.

    Attributes:
        sizes: width and height of each view, pixels.
        origins_world: the views' camera centres.
        warnings: one sentence each on cameras that cannot un-project all of their pixels.
    """

    def __init__(self, model: DatasetModel, tables: RayTables) -> None:
        self._cameras: tuple[Camera, ...] = model.cameras
        self._tables = tables
        self.sizes: Int64[np.ndarray, "v 2"] = np.array(
            [[view.width_px, view.height_px] for view in model.views], dtype=np.int64
        )
        self._view_camera: Int64[np.ndarray, " v"] = np.array(
            [view.camera_index for view in model.views], dtype=np.int64
        )
        self._rotations_world_from_cam: Float64[np.ndarray, "v 3 3"] = np.stack(
            [view.rotation_cam_from_world.T for view in model.views]
        )
        origins = np.stack([view.origin_world for view in model.views])
        self.origins_world: Float32[np.ndarray, "v 3"] = origins.astype(np.float32)
        self._pinhole_params: Float64[np.ndarray, "c 4"] = np.array(
            # The numbers of a camera that is no pinhole are never used.
            [camera.pinhole_params if camera.is_pinhole else (1.0, 1.0, 0.0, 0.0) for camera in model.cameras]
        )
        self._has_no_table = tables.offsets == NO_TABLE_COMPUTED
        lacks_rays = np.array([not (c.is_pinhole or has_rays_everywhere(c)) for c in model.cameras])
        self._has_invalid_rays = self._has_no_table & lacks_rays
        self.warnings: list[str] = []
        if lacks_rays.any():
            models = sorted({model.cameras[index].model for index in np.flatnonzero(lacks_rays)})
            self.warnings.append(
                f"{int(lacks_rays.sum())} cameras ({', '.join(models)}) cannot un-project parts of their "
                "images; these pixels do not count."
            )

    @property
    def arrays(self) -> gather.ViewArrays:
        """Return what kernels need of the views."""
        return gather.ViewArrays(
            self.sizes, self._view_camera, self._tables.offsets, self._tables.values.values
        )

    def trace(
        self, view: Int[np.ndarray, " n"], y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
        """Return origins and unit directions of the rays through pixel centres.

        Raises:
            IndexError: a pixel does not exist.
        """
        view, y, x = as_int64(view), as_int64(y), as_int64(x)
        origins = np.empty((len(view), 3), dtype=np.float32)
        directions = np.empty((len(view), 3), dtype=np.float32)
        bad = gather.gather_rays(
            gather.PixelIndices(view, y, x), self.arrays,
            self._rotations_world_from_cam, self.origins_world, self._pinhole_params, origins, directions,
        )  # fmt: skip
        raise_for_pixels(bad, view, y, x)
        if self._has_no_table.any():
            self._compute_directions(view, y, x, directions)
        return origins, directions

    def invalid_rays(
        self, view: Int64[np.ndarray, " n"], y: Int64[np.ndarray, " n"], x: Int64[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Return which pixels without a table their camera model cannot un-project."""
        is_invalid = np.zeros(len(view), bool)
        if self._has_invalid_rays.any():
            for camera, chosen in self._pixels_by_camera(view, self._has_invalid_rays):
                found = self._cameras[camera].directions_cam(_pixel_centres(y[chosen], x[chosen]))
                is_invalid[chosen] = np.isnan(found).any(axis=1)
        return is_invalid

    def release_pages(self) -> None:
        """Release the mapped pages of the tables to the system."""
        self._tables.values.release()

    def _pixels_by_camera(
        self, view: Int64[np.ndarray, " n"], selected: Bool[np.ndarray, " c"]
    ) -> list[tuple[int, Int64[np.ndarray, " m"]]]:
        """Return the pixels of each selected camera, by its number."""
        camera = self._view_camera[view]
        chosen = np.flatnonzero(selected[camera])
        # One camera after another, as a lens model takes the points of one
        chosen = chosen[np.argsort(camera[chosen], kind="stable")]
        if len(chosen) == 0:
            return []
        groups = np.split(chosen, np.flatnonzero(np.diff(camera[chosen])) + 1)
        return [(int(camera[group[0]]), group) for group in groups]

    def _compute_directions(
        self,
        view: Int64[np.ndarray, " n"],
        y: Int64[np.ndarray, " n"],
        x: Int64[np.ndarray, " n"],
        directions: Float32[np.ndarray, "n 3"],
    ) -> None:
        """Write the directions of pixels whose cameras have no table."""
        for camera, chosen in self._pixels_by_camera(view, self._has_no_table):
            found = self._cameras[camera].directions_cam(_pixel_centres(y[chosen], x[chosen]))
            known = np.isfinite(found).all(axis=1)
            rotations = self._rotations_world_from_cam[view[chosen[known]]]
            directions[chosen[known]] = np.einsum("nij,nj->ni", rotations, found[known])


def as_int64(values: Int[np.ndarray, " n"]) -> Int64[np.ndarray, " n"]:
    """Return numbers of pixels as kernels take them."""
    return np.ascontiguousarray(values, dtype=np.int64)


def raise_for_pixels(
    bad: int, view: Int[np.ndarray, " n"], y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]
) -> None:
    """Raise IndexError if a kernel found that pixel ``bad`` does not exist; -1 is none."""
    if bad >= 0:
        raise IndexError(f"there is no pixel with view {view[bad]}, y {y[bad]}, x {x[bad]}")


def _pixel_centres(y: Int64[np.ndarray, " n"], x: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, "n 2"]:
    return np.stack([x + 0.5, y + 0.5], axis=1)
